"""Hypothesis strategies of damaged files: bytes, words, JSON values, headers, columns."""

import copy
import io
import json
import re
import zipfile
from collections.abc import Callable

from hypothesis import strategies as st

Strategy = st.SearchStrategy[bytes]
INTEGERS = (-1, 0, 1, 2, 5, 127, 255, 65_536, 2**31 - 1, 2**31, 2**32, 2**62, 2**63, 2**64, 10**30, 10**400)
FLOATS = (0.5, -1.5, -0.0, 1e308, -1e308, 1e-320, float("nan"), float("inf"), float("-inf"))
TEXTS = ("", "a", "\0", "\ud800", "é" * 300, "a" * 5000, "../x", "/", "$a$", "%s", "0", "car", "nan")
VALUES = (None, True, False, *INTEGERS, *FLOATS, *TEXTS, [], {}, [[]], [0], [None], {"": None}, [[[[[[]]]]]])
DEEP = (b"[" * 100_000, b'{"a":' * 100_000, b"[" * 5000 + b"]" * 5000)
WORDS = (
    *(str(number).encode() for number in (*INTEGERS, *FLOATS)),
    *(
        b"1e999",
        b"0x10",
        b"1_0",
        b"+3",
        b"",
        b"a",
        b"\0",
        b"\xff\xfe",
        b"\xd9\xa3",
        b"9" * 5000,
        b"../..",
        b"#",
        b"\r",
    ),
    *(b"F F F F", b"I U F F", b"1 2 4 8", b"x x y z", b"1 1 1 1000000"),
    *(
        b"<f8",
        b">f4",
        b"<f2",
        b"|O",
        b"<c8",
        b"<U3",
        b"<M8[s]",
        b"(0, 5)",
        b"(-1, 5)",
        b"(4611686018427387904, 4)",
    ),
    *(b"True", b"None", b"[]"),
)
NUMBERS = [(number % 2**64).to_bytes(8, "little")[:width] for number in INTEGERS for width in (1, 2, 4, 8)]


def damaged(name: str, content: bytes) -> Strategy:
    """The content of a file with a few changes, in ways that suit its kind."""
    kind = _BY_ENDING.get(name.rpartition(".")[2])
    return (
        bytes_changed(content) if kind is None else st.one_of(kind(content), kind(content), bytes_changed(content))
    )


@st.composite
def bytes_changed(draw: st.DrawFn, content: bytes) -> bytes:
    """Replaced, removed, repeated and added bytes."""
    data = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        end = start + draw(st.sampled_from((0, 1, 1, 2, 4, 8, 64, len(data))))
        data[start:end] = draw(
            st.sampled_from((b"", data[start:end] * 2)) | st.sampled_from(NUMBERS) | st.binary()
        )
    return bytes(data)


@st.composite
def words_changed(draw: st.DrawFn, content: bytes) -> bytes:
    """Replaced, removed and repeated words and lines."""
    for _ in range(draw(st.integers(1, 3))):
        pattern = draw(st.sampled_from((rb"[\w.+-]+", rb"[\w.+-]+", rb"(?m)^.*\n", rb"'[^']*'|\([^)]*\)")))
        spans = [match.span() for match in re.finditer(pattern, content)] or [(0, 0)]
        start, end = draw(st.sampled_from(spans))
        content = content[:start] + draw(st.sampled_from((*WORDS, content[start:end] * 2))) + content[end:]
    return content


@st.composite
def json_changed(draw: st.DrawFn, content: bytes) -> bytes:
    """Changed, removed, renamed, exchanged and nested values."""
    root = {"": json.loads(content)}
    for _ in range(draw(st.integers(1, 3))):
        _change_value(draw, root)
    comma = draw(st.sampled_from((*[","] * 9, ',"a":0,"a":1,', f",{DEEP[2].decode()},")))
    return json.dumps(root[""]).replace(",", comma, 1).encode()


def _change_value(draw: st.DrawFn, root: dict) -> None:
    def choose(parent: dict | list):
        return draw(st.sampled_from(list(parent) if isinstance(parent, dict) else range(len(parent))))

    parent, key = root, ""
    while isinstance(value := parent[key], dict | list) and value and draw(st.integers(0, 9)):
        parent, key = value, choose(value)
    match draw(st.sampled_from(("value", "value", "value", "remove", "rename", "exchange", "nest", "scale"))):
        case "remove" if parent is not root:
            del parent[key]
        case "rename" if parent is not root and isinstance(parent, dict):
            parent[draw(st.sampled_from(("a", "token", f"{key} ", *TEXTS)))] = parent.pop(key)
        case "exchange":
            other = choose(parent)
            parent[key], parent[other] = parent[other], value
        case "nest":
            parent[key] = [value]
        case "scale" if isinstance(value, int | float):
            parent[key] = value * draw(st.sampled_from((-1, 0, 2, 1_000_003)))
        case _:
            parent[key] = copy.deepcopy(draw(st.sampled_from(VALUES) | st.text() | st.integers() | st.floats()))


def _json_file(content: bytes) -> Strategy:
    return st.one_of(*[json_changed(content)] * 8, words_changed(content), st.sampled_from(DEEP))


@st.composite
def line_changed(draw: st.DrawFn, content: bytes) -> bytes:
    """One changed line of JSON."""
    lines = content.splitlines()
    i = draw(st.integers(0, len(lines) - 1))
    name, tab, value = lines[i].rpartition(b"\t")  # a resume log names the sample first
    change = json_changed if value.startswith((b"{", b"[")) else bytes_changed
    lines[i] = name + tab + draw(change(value))
    return b"\n".join(lines) + b"\n"


@st.composite
def npy_changed(draw: st.DrawFn, content: bytes) -> bytes:
    """A changed header, length of the header, or values."""
    end = 10 + int.from_bytes(content[8:10], "little")
    header, values = content[10:end], content[end:]
    if draw(st.booleans()):
        header = draw(words_changed(header))
    else:
        values = draw(bytes_changed(values))
    length = draw(st.sampled_from((*[len(header)] * 6, 0, 1, 65_535)))
    return content[:8] + length.to_bytes(2, "little") + header + values


@st.composite
def npz_changed(draw: st.DrawFn, content: bytes) -> bytes:
    """A changed, renamed, repeated or missing array."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = draw(st.sampled_from(list(members)))
    match draw(st.sampled_from(("values", "values", "rename", "repeat", "remove"))):
        case "values":
            members[name] = draw(npy_changed(members[name]))
        case "rename":
            members[draw(st.sampled_from(("points.npy", "points", "a.npy", "../a.npy", " ")))] = members.pop(name)
        case "repeat":
            members["more.npy"] = members[name]
        case "remove":
            del members[name]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", draw(st.sampled_from((zipfile.ZIP_STORED, zipfile.ZIP_BZIP2)))) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return file.getvalue()


@st.composite
def pcd_changed(draw: st.DrawFn, content: bytes) -> bytes:
    """A changed header, or values."""
    cut = content.find(b"\n", content.find(b"DATA")) + 1
    header, body = content[:cut], content[cut:]
    if draw(st.integers(0, 3)) == 0:
        return header + draw(bytes_changed(body))
    field = draw(st.sampled_from((b"SIZE", b"TYPE", b"COUNT", b"FIELDS", b"POINTS", b"WIDTH", b"HEIGHT")))
    words = draw(st.sampled_from(WORDS))
    changed = re.sub(field + rb" .*", lambda _: field + b" " + words, header)
    return draw(st.sampled_from((changed, draw(words_changed(header))))) + body


@st.composite
def feather_changed(draw: st.DrawFn, content: bytes) -> bytes:
    """A changed, repeated or missing column, or fewer rows."""
    import pyarrow as pa

    table = pa.ipc.open_file(content).read_all()
    i = draw(st.integers(0, table.num_columns - 1))
    name, values = table.column_names[i], table.column(i).to_pylist()
    match draw(st.sampled_from(("remove", "repeat", "type", "value", "rows"))):
        case "remove":
            table = table.remove_column(i)
        case "repeat":
            table = table.append_column(draw(st.sampled_from((name, "a"))), table.column(i))
        case "type":
            other = draw(st.sampled_from((None, True, "a", b"a", 0.5, [1], {"a": 1}, 2**63 - 1, float("nan"))))
            table = table.set_column(i, name, pa.array([other] * len(values)))
        case "value":
            row = draw(st.integers(0, len(values) - 1))
            values[row] = draw(st.sampled_from((None, type(values[0])(), values[-1], values[0] * 2)))
            table = table.set_column(i, name, pa.array(values))
        case "rows":
            table = table.slice(draw(st.integers(0, len(values) - 1)), draw(st.integers(0, 1)))
    sink = pa.BufferOutputStream()
    options = pa.ipc.IpcWriteOptions(compression=draw(st.sampled_from((None, "lz4", "zstd"))))
    with pa.ipc.new_file(sink, table.schema, options=options) as writer:
        writer.write_table(table)
    return sink.getvalue().to_pybytes()


_BY_ENDING: dict[str, Callable[[bytes], Strategy]] = {
    "json": _json_file,
    "jsonl": line_changed,
    "resume_log": line_changed,
    "txt": words_changed,
    "npy": npy_changed,
    "npz": npz_changed,
    "pcd": pcd_changed,
    "feather": feather_changed,
}

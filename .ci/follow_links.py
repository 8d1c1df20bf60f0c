"""Check that every link from one page of a built site to another leads to a page, a file or a place in a page.

python follow_links.py FOLDER
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlsplit


class Page(HTMLParser):
    """Where a page links to, and the places in it."""

    def __init__(self, text: str):
        super().__init__()
        self.links: list[str] = []
        self.places = {"", "top"}  # the browser's own
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("href", "src") and value is not None:
                self.links.append(value)
            elif name == "id" and value is not None:
                self.places.add(value)


site = Path(sys.argv[1]).resolve()
pages = {file: Page(file.read_text(encoding="utf-8")) for file in sorted(site.rglob("*.html"))}
followed, broken = 0, []
for file, page in pages.items():
    for link in page.links:
        if urlsplit(link).scheme or link.startswith("//"):
            continue
        target, place = map(unquote, urldefrag(link))
        there = (file.parent / target.partition("?")[0]).resolve() if target else file
        followed += 1
        if not there.is_relative_to(site) or not there.is_file() or place not in pages.get(there, page).places:
            broken.append(f"{file.relative_to(site)}: {link}: leads nowhere")
for line in sorted(set(broken)):
    print(line)
print(f"{site.name}: {len(pages)} pages, {followed} links inside, {len(broken)} broken")
sys.exit(bool(broken or not pages))

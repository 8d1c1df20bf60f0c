"""The same network for timings, written like PyTorch's users would write it.

Modality-wise stem by ``groups=9``, LiDAR-Net, feature pyramid, heads with group norm, 1x1 merges per branch.
Sizes come from the environment: ``BATCH`` and ``HEIGHT`` of the images, their ``ROUNDS``, and the channels of each
``TYPE``, of ``STEM``, ``PYRAMID``, ``HEAD`` and the backbone's stages (``WIDTHS``). ``DEVICE`` is ``cpu`` or
``cuda``. ``AUTOCAST`` to bfloat16 and ``COMPILE`` by ``torch.compile`` are 0 or 1. ``FNS["forward"]`` is a forward
pass as in detection, ``FNS["train"]`` a forward and a backward pass; there is no assignment, no optimizer and no
projection in it. Needs torch, which the project itself does not.
"""

import os

import torch  # type: ignore[import-not-found]
import torch.nn.functional as F  # type: ignore[import-not-found]
from torch import nn  # type: ignore[import-not-found]

HEIGHT, ROUNDS, BATCH = (int(os.environ[name]) for name in ("HEIGHT", "ROUNDS", "BATCH"))
TYPE, STEM, PYRAMID, HEAD = (int(os.environ[name]) for name in ("TYPE", "STEM", "PYRAMID", "HEAD"))
WIDTHS = tuple(map(int, os.environ["WIDTHS"].split(",")))
WIDTH, BLOCKS, STRIDES = 1088, (4, 4, 1, 1), (1, 2, 2, 2)
DEVICE = os.environ.get("DEVICE", "cpu")
AUTOCAST, COMPILE = (os.environ.get(name) == "1" for name in ("AUTOCAST", "COMPILE"))


def conv(inputs: int, outputs: int, size: int, **options: int) -> nn.Conv2d:
    """Without bias, padded to keep the size."""
    padding = options.get("dilation", 1) * (size // 2)
    return nn.Conv2d(inputs, outputs, size, padding=padding, bias=False, **options)


def _normed(*args: int, **options: int) -> nn.Sequential:
    layer = conv(*args, **options)
    return nn.Sequential(layer, nn.BatchNorm2d(layer.out_channels), nn.ReLU(inplace=True))


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 with a shortcut."""

    def __init__(self, inputs: int, width: int, stride: int, project: bool) -> None:
        super().__init__()
        wide, narrow = 4 * width, (_normed(inputs, width, 1), _normed(width, width, 3, stride=stride))
        self.body = nn.Sequential(*narrow, conv(width, wide, 1), nn.BatchNorm2d(wide))
        shortcut = nn.Sequential(conv(inputs, wide, 1, stride=stride), nn.BatchNorm2d(wide))
        self.shortcut = shortcut if project else nn.Identity()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.relu(self.body(x) + self.shortcut(x))


def _tower() -> nn.Sequential:
    layers = []
    for inputs in (PYRAMID, HEAD, HEAD, HEAD):
        layers += [conv(inputs, HEAD, 3), nn.GroupNorm(min(32, HEAD // 2), HEAD), nn.ReLU(True)]
    return nn.Sequential(*layers)


class Network(nn.Module):
    """Stem, backbone, pyramid and heads."""

    def __init__(self) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            nn.Sequential(
                _normed(9 * ROUNDS, 9 * TYPE, 3, dilation=d, groups=9),
                _normed(9 * TYPE, 9 * TYPE, 3, dilation=d, groups=9),
                conv(9 * TYPE, STEM, 1),
            )
            for d in (1, 3, 6)
        )
        self.merged, self.first = nn.Sequential(nn.BatchNorm2d(STEM), nn.ReLU(True)), _normed(STEM, STEM, 7)
        self.stages, inputs = nn.ModuleList(), STEM
        for count, width, stride in zip(BLOCKS, WIDTHS, STRIDES, strict=True):
            later = (Bottleneck(4 * width, width, 1, False) for _ in range(count - 1))
            self.stages.append(nn.Sequential(Bottleneck(inputs, width, stride, True), *later))
            inputs = 4 * width
        self.laterals = nn.ModuleList(nn.Conv2d(4 * w, PYRAMID, 1) for w in WIDTHS)
        self.outputs = nn.ModuleList(nn.Conv2d(PYRAMID, PYRAMID, 3, 1 if i < 4 else 2, 1) for i in range(6))
        self.heads = nn.ModuleList(
            nn.ModuleList([_tower(), nn.Conv2d(HEAD, 11, 3, 1, 1), _tower(), nn.Conv2d(HEAD, 110, 3, 1, 1)])
            for _ in range(6)
        )

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Logits and numbers of every level."""
        x, levels = self.first(self.merged(sum(branch(image) for branch in self.branches))), []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        laterals = [lateral(x) for lateral, x in zip(self.laterals, levels, strict=True)]
        for i in (2, 1, 0):
            laterals[i] = laterals[i] + F.interpolate(laterals[i + 1], scale_factor=2, mode="nearest")
        pyramid = [output(x) for output, x in zip(self.outputs[:4], laterals, strict=True)]
        pyramid.append(self.outputs[4](pyramid[-1]))
        pyramid.append(self.outputs[5](F.relu(pyramid[-1])))
        found = []
        for x, (classify, logits, regress, numbers) in zip(pyramid, self.heads, strict=True):
            found += [logits(classify(x)), numbers(regress(x))]
        return found


torch.backends.cudnn.benchmark = torch.backends.cudnn.allow_tf32 = True  # As XLA does by default.
network = Network().to(DEVICE, memory_format=torch.channels_last)
run = torch.compile(network) if COMPILE else network
images = torch.randn(BATCH, 9 * ROUNDS, HEIGHT, WIDTH, device=DEVICE)
images = images.contiguous(memory_format=torch.channels_last)


def _outputs() -> list[torch.Tensor]:
    with torch.autocast(DEVICE, torch.bfloat16, enabled=AUTOCAST):
        return run(images)


def _finish() -> None:
    if DEVICE == "cuda":  # otherwise only the launches are timed
        torch.cuda.synchronize()


def forward() -> None:
    """One forward pass without gradients, with the statistics of batch normalization fixed."""
    if network.training:
        network.eval()
    with torch.no_grad():
        _outputs()
    _finish()


def train() -> None:
    """One forward and one backward pass."""
    network.zero_grad(set_to_none=True)
    torch.stack([y.abs().mean() for y in _outputs()]).sum().backward()
    _finish()


FNS = {"forward": forward, "train": train}

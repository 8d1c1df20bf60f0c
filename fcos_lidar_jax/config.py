"""Frozen configurations with the paper's values as defaults.

Fields marked "reading" settle what the paper leaves open; ``docs/assumptions.md`` lists them all.
Variants are made with :func:`dataclasses.replace`; every configuration is hashable and validated.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal, Self, get_args, get_origin, get_type_hints

from fcos_lidar_jax.classes import DEFAULT_PASTE_TARGET, DEFAULT_RANGE_M, NUSCENES_CLASSES, PASTE_TARGETS, RANGES_M
from fcos_lidar_jax.sensors import Sensor


def _check(condition: bool, field: str, got: object, expected: str) -> None:
    if not condition:
        raise ValueError(f"{field}: got {got!r}, expected {expected}")


MAX_ROUNDS = 100  # Of the projection, each a pass over the points and an image: far more than ever helped.


def _check_least(config: Any, least: int, *fields: str) -> None:
    for field in fields:
        _check(getattr(config, field) >= least, field, getattr(config, field), f"at least {least}")


def _check_hashable(section: Any) -> None:
    """Programs are compiled once a configuration: it is looked up by its hash, which lists do not have."""
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            _check_hashable(value)
        else:
            _check(not isinstance(value, list | dict | set), field.name, value, "a tuple")


def _check_choices(config: Any) -> None:
    """Every ``Literal`` field of a configuration holds one of its choices."""
    for name, hint in get_type_hints(type(config)).items():
        if get_origin(hint) is Literal:
            value = getattr(config, name)
            choices = get_args(hint)
            _check(value in choices, name, value, "one of " + ", ".join(map(repr, choices)))


@dataclasses.dataclass(frozen=True)
class CloudReading:
    """How clouds are read, the same in training, evaluation and detection; see :attr:`Config.reading`.

    >>> CloudReading(num_sweeps=0)
    Traceback (most recent call last):
    ValueError: num_sweeps: got 0, expected at least 1
    """

    num_sweeps: int = 1  # Sweeps fused at most, the current one included; fewer where the data have fewer.
    remove_close: Literal["all", "sweeps", "none"] = "sweeps"
    """Sweeps that lose the points on the ego vehicle, each judged in its own frame: all, only the older ones, or
    none."""
    close_m: float = 1.0  # Half the side of the square around the sensor that is emptied, metres.

    def __post_init__(self) -> None:
        _check_least(self, 1, "num_sweeps")
        _check(0 < self.close_m < math.inf, "close_m", self.close_m, "a positive number of metres")
        _check_choices(self)


WHOLE_SWEEP = CloudReading(remove_close="none")
"""The current sweep with every point."""


@dataclasses.dataclass(frozen=True)
class ProjectionConfig:
    """Points to range image (paper, sections 3.1 and 3.2).

    >>> ProjectionConfig(num_rounds=3).prioritize_current
    True
    """

    num_rounds: int = 5  # Rounds of the multi-round projection.
    prioritize_current: bool = True  # Points of the current sweep win every collision with older ones (table 2).
    remove_close: Literal["all", "sweeps", "none"] = CloudReading.remove_close
    """Reading: drop the points on the ego vehicle, ``|x|, |y| < close_m``, of all sweeps, of the older sweeps only
    (which gives the paper's numbers of points), or not at all."""
    close_m: float = CloudReading.close_m
    """Reading: half the side of the square that ``remove_close`` empties, metres."""

    def __post_init__(self) -> None:
        _check(1 <= self.num_rounds <= MAX_ROUNDS, "num_rounds", self.num_rounds, f"1 to {MAX_ROUNDS}")
        _check(0 < self.close_m < math.inf, "close_m", self.close_m, "a positive number of metres")
        _check_choices(self)


@dataclasses.dataclass(frozen=True)
class StemConfig:
    """Modality-wise convolutions (paper, section 3.3, tables 3-5).

    >>> StemConfig(groups="modalities").dilations
    (1, 3, 6)
    """

    groups: Literal["types", "modalities", "all"] = "types"
    """9 groups by channel type, 5 by modality, or one group (table 3)."""
    group_rounds: bool = True  # All rounds of a channel type share a group (table 3, last row: False).
    num_convs: int = 2  # 3x3 grouped convolutions a branch (table 4).
    dilations: tuple[int, ...] = (1, 3, 6)  # One parallel branch each, summed (table 5).
    channels_per_type: int = 32  # Features of one channel type.
    out_channels: int = 64  # Channels after the 1x1 merge.
    merge: Literal["per_branch", "shared"] = "per_branch"
    """Reading: every branch has its own 1x1 merge, or one is shared."""

    def __post_init__(self) -> None:
        _check_least(self, 1, "num_convs", "channels_per_type", "out_channels")
        several = len(self.dilations) >= 1 and min(self.dilations) >= 1
        _check(several, "dilations", self.dilations, "one or more integers of at least 1")
        possible = self.group_rounds or self.groups == "types"
        _check(possible, "group_rounds", self.group_rounds, "True unless groups is 'types'")
        _check_choices(self)


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """LiDAR-Net, feature pyramid and heads (paper, section 3.4).

    >>> ModelConfig(head_channels=128).stem.num_convs
    2
    """

    stem: StemConfig = StemConfig()  # Modality-wise convolutions.
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the convolutions behind the first layer; geometry, statistics, predictions, assignment and losses are
    float32 in any case."""
    remat: bool = False
    """Compute the activations of the stem and of the backbone's first stage again in the backward pass instead of
    keeping them: the same result with less memory and more time, except on CPUs, where XLA undoes it."""
    row_upscale: int = 2  # Rows are repeated this many times (paper, section 4).
    circular_width: bool = False
    """Reading: wrap every convolution around the azimuth instead of the paper's zero padding; the azimuth is
    then binned into a width divisible by 32."""
    backbone_blocks: tuple[int, int, int, int] = (4, 4, 1, 1)  # Bottlenecks a stage.
    backbone_widths: tuple[int, int, int, int] = (64, 128, 128, 128)
    """Bottleneck widths; a stage puts out four times as many channels."""
    fpn_channels: int = 256  # Reading: channels of P2..P7.
    head_channels: int = 64  # Channels of both towers (128 for the test set).
    head_convs: int = 4  # 3x3 convolutions a tower.
    tied_heads: bool = False  # Share the heads between the levels (table 6).
    regression_axes: Literal["lidar", "ray"] = "lidar"
    """Axes of the predicted centre offset and velocity: those of the LiDAR frame, as in equation 2, or, not in the
    paper, the direction of the point's azimuth and the one to its left, see :mod:`fcos_lidar_jax.coding`."""
    local_geometry: bool = False
    """Not in the paper: each location's offsets to the points of the neighbouring pixels as further input of its
    head, see ``fcos_lidar_jax.models.local_geometry``."""
    background_prior: float = 0.99  # Reading: the background's probability at the start.
    channel_mean: tuple[float, ...] = (0.0, 0.0, -1.24, 12.5, 0.0, -0.21, 25.5, 0.0, 0.224)
    """Reading: subtracted from the nine channels in the preprocessing."""
    channel_scale: tuple[float, ...] = (11.4, 11.4, 1.15, 10.7, 1.8, 0.19, 22.4, 1.0, 0.144)
    """Reading: the nine channels are divided by it."""

    def __post_init__(self) -> None:
        _check_least(self, 1, "row_upscale", "head_convs", "fpn_channels", "head_channels")
        for name in ("backbone_blocks", "backbone_widths"):
            stages = getattr(self, name)
            _check(len(stages) == 4 and min(stages) >= 1, name, stages, "four stages of at least 1")
        groups = max(1, min(32, self.head_channels // 2))  # Of the towers' group norms, see models.layers.
        _check(self.head_channels % groups == 0, "head_channels", self.head_channels, f"a multiple of {groups}")
        prior = self.background_prior
        _check(0 < prior < 1, "background_prior", prior, "a probability between 0 and 1")
        nine = len(self.channel_mean) == 9 and all(map(math.isfinite, self.channel_mean))
        _check(nine, "channel_mean", self.channel_mean, "nine finite numbers")
        nine = len(self.channel_scale) == 9 and all(0 < scale < math.inf for scale in self.channel_scale)
        _check(nine, "channel_scale", self.channel_scale, "nine positive numbers")
        _check_choices(self)


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Assignment and losses (paper, section 3.4).

    >>> LossConfig(top_q=0)
    Traceback (most recent call last):
    ValueError: top_q: got 0, expected at least 1
    """

    top_q: int = 20  # Q: K of a box is the rounded sum of its Q highest IoUs.
    regress_on: Literal["positives", "candidates"] = "positives"
    """Reading: box and IoU losses act on, and are divided by, the positives, or all locations inside a box."""
    iou_loss: Literal["iou", "log_iou", "giou", "diou"] = "iou"
    """Reading: 1 - IoU, UnitBox's -ln IoU, or the generalised and distance forms."""
    classification_weight: float = 1.0  # Reading: of the cross-entropy.
    l1_weight: float = 0.25  # Reading: of the L1 loss.
    iou_weight: float = 1.0  # Reading: of the IoU loss.
    iou_prediction_weight: float = 1.0  # Reading: of the binary cross-entropy of the predicted IoU.
    velocity_weight: float = 0.2  # Reading: of the two velocity numbers within the L1 loss.
    quality: Literal["iou", "centreness"] = "iou"
    """What the factor of the score is trained to be: the rotated 3D IoU, or, not in the paper, how near the
    predicted centre is, see :func:`fcos_lidar_jax.losses.centreness`."""
    centreness_m: float = 0.75  # Distance of the centres at which the centreness is 1 / e, metres.

    def __post_init__(self) -> None:
        _check_least(self, 1, "top_q")
        for name, value in vars(self).items():
            if name.endswith("_weight"):
                _check(math.isfinite(value) and value >= 0, name, value, "a finite number of at least 0")
        width = self.centreness_m
        _check(math.isfinite(width) and width > 0, "centreness_m", width, "a positive number of metres")
        used = self.quality == "centreness" or width == LossConfig.centreness_m
        _check(used, "centreness_m", width, f"{LossConfig.centreness_m} unless quality is centreness")
        _check_choices(self)


@dataclasses.dataclass(frozen=True)
class InferenceConfig:
    """Predictions to detections (paper, section 3.4).

    >>> InferenceConfig(max_detections=100).iou_threshold
    0.2
    """

    min_probability: float = 0.01  # Candidates need a class probability above this, before the IoU factor.
    iou_threshold: float = 0.2  # NMS suppresses what overlaps a better box of its class by more than this.
    max_detections: int = 500  # Boxes kept.
    candidates_per_level: int = 1000  # Reading: (location, class) pairs that enter NMS from each level.
    nms_overlap: Literal["bev", "3d"] = "bev"  # Reading: rotated IoU in the ground plane, or of the boxes.
    iou_exponent: float = 1.0
    """The score is the class probability times the predicted IoU to this power: 1 in the paper, 0 for none, others
    as in CIA-SSD (Zheng et al., AAAI 2021)."""
    merge_iou: float | None = None
    """Not in the paper: weighted NMS, by which a kept box becomes the mean of those that overlap it by more than
    this, see ``nms.merge_boxes``; None: it stays as it is."""
    flips: Literal["none", "x", "y", "xy"] = "none"
    """Not in the paper: mirrored views of the cloud that are detected beside it, their boxes mirrored back; "xy"
    all three. Only flips of the training."""

    def __post_init__(self) -> None:
        _check(0 <= self.min_probability < 1, "min_probability", self.min_probability, "within [0, 1)")
        _check(0 <= self.iou_threshold <= 1, "iou_threshold", self.iou_threshold, "within [0, 1]")
        _check_least(self, 1, "max_detections", "candidates_per_level")
        _check(0 <= self.iou_exponent < math.inf, "iou_exponent", self.iou_exponent, "finite, 0 or more")
        _check(self.merge_iou is None or 0 <= self.merge_iou <= 1, "merge_iou", self.merge_iou, "within [0, 1]")
        _check_choices(self)


@dataclasses.dataclass(frozen=True)
class AugmentConfig:
    """On-device augmentation of points and boxes together (paper, section 4).

    >>> AugmentConfig(max_rotation_rad=0.0).scale_range
    (0.95, 1.05)
    """

    flip_x_probability: float = 0.5  # Reading: of x -> -x.
    flip_y_probability: float = 0.5  # Reading: of y -> -y, drawn independently.
    max_rotation_rad: float = math.pi  # The rotation about z is uniform within plus and minus this.
    scale_range: tuple[float, float] = (0.95, 1.05)  # The scale is uniform within it.

    def __post_init__(self) -> None:
        for name in ("flip_x_probability", "flip_y_probability"):
            _check(0 <= getattr(self, name) <= 1, name, getattr(self, name), "a probability")
        angle = self.max_rotation_rad
        _check(0 <= angle < math.inf, "max_rotation_rad", angle, "a finite angle of at least 0")
        low, high = self.scale_range
        _check(0 < low <= high < math.inf, "scale_range", self.scale_range, "finite (low, high), 0 < low <= high")


@dataclasses.dataclass(frozen=True)
class CopyPasteConfig:
    """Objects of other frames pasted into a training frame (paper, section 4, after SECOND).

    >>> CopyPasteConfig(targets=(2, 3)).min_points
    5
    """

    targets: tuple[int, ...] = ()
    """Reading: boxes of each class that a frame is filled up to, those present included; (): by the class's name,
    see ``classes.PASTE_TARGETS``."""
    min_points: int = 5  # Points an object needs, counted over the sweeps that are pasted.

    def __post_init__(self) -> None:
        _check(min(self.targets, default=0) >= 0, "targets", self.targets, "counts of at least 0")
        _check_least(self, 1, "min_points")


@dataclasses.dataclass(frozen=True)
class OptimizerConfig:
    """One-cycle AdamW (paper, section 4).

    >>> OptimizerConfig(batch_size=32, accumulate=3)
    Traceback (most recent call last):
    ValueError: accumulate: got 3, expected a divisor of the batch size 32
    """

    peak_learning_rate: float = 1e-2  # At the end of the warm-up.
    initial_divisor: float = 10.0  # The first learning rate is the peak divided by it.
    final_divisor: float = 1e4  # The last learning rate is the first divided by it.
    warmup_fraction: float = 0.4  # Part of the steps on the way up.
    b1_range: tuple[float, float] = (0.85, 0.95)
    """Momentum: high at both ends, low at the peak of the learning rate; cosine (reading)."""
    b2: float = 0.99  # Reading: decay of the second moment.
    weight_decay: float = 0.01  # On all parameters (reading).
    max_gradient_norm: float = 35.0  # Reading: global-norm clipping.
    batch_size: int = 32  # Reading: samples a step over all devices.
    accumulate: int = 1
    """Micro-batches a step; gradients and counts are summed and divided once, batch norm sees a micro-batch."""
    ema_decay: float = 0.0  # Of the running mean of the weights, which detection then uses; 0 for none (paper).
    epochs: int = 40  # Passes over the training set.

    def __post_init__(self) -> None:
        for name in ("peak_learning_rate", "initial_divisor", "final_divisor", "max_gradient_norm"):
            value = getattr(self, name)
            _check(0 < value < math.inf, name, value, "finite, above 0")
        _check(0 <= self.weight_decay < math.inf, "weight_decay", self.weight_decay, "finite, 0 or more")
        _check(0 <= self.b2 < 1, "b2", self.b2, "within [0, 1)")
        low, high = self.b1_range
        _check(0 < low <= high < 1, "b1_range", self.b1_range, "(low, high) with 0 < low <= high < 1")
        _check(0 < self.warmup_fraction < 1, "warmup_fraction", self.warmup_fraction, "between 0 and 1")
        _check_least(self, 1, "batch_size", "epochs")
        divides = self.accumulate >= 1 and self.batch_size % self.accumulate == 0
        _check(divides, "accumulate", self.accumulate, f"a divisor of the batch size {self.batch_size}")
        _check(0 <= self.ema_decay < 1, "ema_decay", self.ema_decay, "within [0, 1)")


@dataclasses.dataclass(frozen=True)
class Config:
    """All that defines a detector and its training, but for the data.

    It describes FCOS-LiDAR. A subclass with fields of its own describes another detector and builds it, see
    ``fcos_lidar_jax.centerpoint``.

    >>> from dataclasses import replace
    >>> paper = Config()
    >>> variant = replace(paper, projection=replace(paper.projection, num_rounds=3))
    >>> variant.projection.num_rounds, variant == paper
    (3, False)
    """

    name: str = "nuscenes"  # Preset it started from.
    sensor: str = "nuscenes_hdl32e"  # Sensor preset, or the path of a sensor file.
    classes: tuple[str, ...] = NUSCENES_CLASSES
    """Names of the classes that are detected, one logit each and one more, last, for the background."""
    class_ranges_m: tuple[float, ...] = ()
    """Greatest distance at which each class is evaluated; (): by the class's name, see ``classes.RANGES_M``."""
    num_sweeps: int = 10  # Sweeps fused into one cloud, the current one included.
    max_points: int = 300_000  # Reading: rows a fused cloud is padded to.
    max_boxes: int = 256  # Reading: rows the ground truth is padded to.
    fade_epochs: int = 0  # Last epochs without copy-paste (paper, section 4.5: 5 for the test set).
    copy_paste: CopyPasteConfig | None = CopyPasteConfig()  # From the ground-truth database; None for none.
    class_balanced: bool = True  # Reading: frames are resampled so that every class is drawn equally often (CBGS).
    projection: ProjectionConfig = ProjectionConfig()  # Points to range image.
    model: ModelConfig = ModelConfig()  # The network.
    loss: LossConfig = LossConfig()  # Assignment and losses.
    inference: InferenceConfig = InferenceConfig()  # Predictions to detections.
    augment: AugmentConfig | None = AugmentConfig()  # Augmentation of a training step; None for none.
    optimizer: OptimizerConfig = OptimizerConfig()  # Optimizer and schedule.

    def __post_init__(self) -> None:
        _check_hashable(self)
        _check_least(self, 1, "num_sweeps", "max_points", "max_boxes")
        _check_least(self, 0, "fade_epochs")
        names = self.classes
        _check(len(names) >= 1 and all(names), "classes", names, "one or more names")
        _check(len(set(names)) == len(names), "classes", names, "different names")
        stem, rounds = self.model.stem, self.projection.num_rounds
        enough = stem.group_rounds or stem.channels_per_type >= rounds
        expected = f"at least the {rounds} rounds, which are convolved apart"
        _check(enough, "model.stem.channels_per_type", stem.channels_per_type, expected)
        targets = self.copy_paste.targets if self.copy_paste else ()
        for field, values in (("class_ranges_m", self.class_ranges_m), ("copy_paste.targets", targets)):
            _check(len(values) in (0, len(names)), field, values, f"{len(names)} values, one a class, or none")
        _check(all(v > 0 for v in self.class_ranges_m), "class_ranges_m", self.class_ranges_m, "values above 0")
        for axis in self.inference.flips if self.inference.flips != "none" else "":
            seen = self.augment is not None and getattr(self.augment, f"flip_{axis}_probability") > 0
            _check(seen, "inference.flips", self.inference.flips, f"augment.flip_{axis}_probability above 0")

    @classmethod
    def of(cls, other: "Config", **changes: Any) -> Self:
        """The configuration of another detector as one of this, with the fields that both have, and changes."""
        return cls(**{name: getattr(other, name) for name in _names(cls) & _names(other)} | changes)

    def build(self, sensor: Sensor) -> Any:
        """The :class:`fcos_lidar_jax.models.Detector` of a subclass; None for FCOS-LiDAR."""
        return None

    @property
    def reading(self) -> CloudReading:
        """How the clouds of this configuration are read."""
        return CloudReading(self.num_sweeps, self.projection.remove_close, self.projection.close_m)

    @property
    def ranges_m(self) -> dict[str, float]:
        """Class -> greatest distance at which it is evaluated, in metres."""
        given = self.class_ranges_m or [RANGES_M.get(name, DEFAULT_RANGE_M) for name in self.classes]
        return dict(zip(self.classes, given, strict=True))

    @property
    def paste_targets(self) -> tuple[int, ...]:
        """Boxes of each class that copy-paste fills a frame up to; nothing without copy-paste."""
        if self.copy_paste is None:
            return (0,) * len(self.classes)
        by_name = tuple(PASTE_TARGETS.get(name, DEFAULT_PASTE_TARGET) for name in self.classes)
        return self.copy_paste.targets or by_name


def config_to_json(config: Config) -> dict[str, Any]:
    """The configuration as a JSON object.

    >>> config_from_json(config_to_json(Config())) == Config()
    True
    """
    record = dataclasses.asdict(config)
    if (kind := _kind_of(record)) is not type(config):
        raise ValueError(
            f"config: got fields of {kind.__name__}, expected one that only {type(config).__name__} has"
        )
    return record


def _kind_of(record: Mapping[str, Any]) -> type[Config]:
    """The class of a configuration: the last subclass that adds a field which the record has."""
    kinds: list[type[Config]] = [Config]
    for kind in kinds:
        kinds += kind.__subclasses__()
    for kind in reversed(kinds[1:]):
        if any(record.get(name) is not None for name in _names(kind) - _names(kind.__base__)):
            return kind
    return Config


def _names(kind: Any) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)}


def config_from_json(record: Any, where: str = "config") -> Config:
    """A configuration from the JSON object that :func:`config_to_json` wrote.

    The fields say which detector it describes, among the classes that the program has defined; nothing is
    imported. A section of another detector may be null.

    Args:
        record, where: the parsed JSON value, and what to call its source in messages.

    Raises:
        ValueError: naming ``where``, the field, what was found and what was expected.

    >>> config_from_json({"name": "mine"}, "mine.json")
    Traceback (most recent call last):
    ValueError: mine.json.sensor: missing
    """
    if not isinstance(record, Mapping):
        return _from_json(Config, record, where)
    kind = _kind_of(record)
    given = {name: value for name, value in record.items() if value is not None or name in _names(kind)}
    return _from_json(kind, given, where)


def _from_json(kind: Any, value: Any, where: str) -> Any:
    """``value`` as the type ``kind``: a configuration, a tuple, a choice or a plain value."""
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, Mapping):
            raise ValueError(f"{where}: got {type(value).__name__}, expected a JSON object")
        hints = get_type_hints(kind)
        for name in value:
            if name not in hints:
                raise ValueError(f"{where}.{name}: unknown field, expected one of {', '.join(hints)}")
        for name in hints:
            if name not in value:
                raise ValueError(f"{where}.{name}: missing")
        fields = {name: _from_json(hint, value[name], f"{where}.{name}") for name, hint in hints.items()}
        try:
            return kind(**fields)  # type: ignore[operator]
        except ValueError as error:
            raise ValueError(f"{where}.{error}") from None
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{where}: got {value!r}, expected a list")
        kinds = [args[0]] * len(value) if args[-1] is Ellipsis else args
        if len(kinds) != len(value):
            raise ValueError(f"{where}: got {len(value)} values, expected {len(kinds)}")
        return tuple(_from_json(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, value, strict=True)))
    if args:  # AugmentConfig | None
        return None if value is None else _from_json(args[0], value, where)
    accepted = (int, float) if kind is float else kind
    fits = kind is not float or (isinstance(value, int | float) and not 1e300 < abs(value) < math.inf)
    if not (isinstance(value, accepted) and fits) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{where}: got {value!r}, expected {kind.__name__}")
    return kind(value)

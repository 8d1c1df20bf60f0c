"""Frozen configurations with the paper's values as defaults.

"Our choice" marks fields that the paper leaves open; ``docs/assumptions.md`` lists all of them.
Make variants with :func:`dataclasses.replace`. Every configuration is hashable and checked at construction.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from fcos_lidar_jax.classes import DEFAULT_PASTE_TARGET, DEFAULT_RANGE_M, NUSCENES_CLASSES, PASTE_TARGETS, RANGES_M
from fcos_lidar_jax.fields import (
    Amount,
    BelowOne,
    Between,
    Bounds,
    Checked,
    Count,
    Counts,
    Finite,
    Natural,
    Positive,
    Positives,
    Range,
    Share,
    check,
    check_per_class,
    from_json,
)
from fcos_lidar_jax.sensors import Sensor

MAX_ROUNDS = 100  # Each round is a pass over the points: far more rounds than ever helped.


@dataclasses.dataclass(frozen=True)
class CloudReading(Checked):
    """How to read point clouds, in training, evaluation and detection; see :attr:`Config.reading`."""

    num_sweeps: Count = 1  # Maximum number of fused sweeps, including the current one.
    remove_close: Literal["all", "sweeps", "none"] = "sweeps"
    """Sweeps from which the points on the ego vehicle are removed, each in its own frame: all, only the older
    ones, or none."""
    close_m: Positive = 1.0  # Half the side of the square around the sensor that is cleared, metres.


WHOLE_SWEEP = CloudReading(remove_close="none")
"""The current sweep with every point."""


@dataclasses.dataclass(frozen=True)
class ProjectionConfig(Checked):
    """Points to range image (paper, sections 3.1 and 3.2)."""

    num_rounds: Annotated[int, Bounds(1, MAX_ROUNDS)] = 5  # Rounds of the multi-round projection.
    prioritize_current: bool = True  # Points of the current sweep win all collisions with older points (table 2).
    remove_close: Literal["all", "sweeps", "none"] = CloudReading.remove_close
    """Our choice: remove the points on the ego vehicle, ``|x|, |y| < close_m``, from all sweeps, from the older
    sweeps only (which gives the paper's numbers of points), or from none."""
    close_m: Positive = CloudReading.close_m
    """Our choice: half the side of the square that ``remove_close`` clears, metres."""


@dataclasses.dataclass(frozen=True)
class StemConfig(Checked):
    """Modality-wise convolutions (paper, section 3.3, tables 3-5)."""

    groups: Literal["types", "modalities", "all"] = "types"
    """Nine groups by channel type, five by modality, or one group (table 3)."""
    group_rounds: bool = True  # All rounds of a channel type share a group (table 3, last row: False).
    num_convs: Count = 2  # 3x3 grouped convolutions per branch (table 4).
    dilations: Counts = (1, 3, 6)  # Dilation of each parallel branch; branches are summed (table 5).
    channels_per_type: Count = 32  # Features per channel type.
    out_channels: Count = 64  # Channels after the 1x1 merge.
    merge: Literal["per_branch", "shared"] = "per_branch"
    """Our choice: one 1x1 merge per branch, or one shared by all branches."""

    def __post_init__(self) -> None:
        super().__post_init__()
        separable = self.group_rounds or self.groups == "types"
        check(separable, "group_rounds", self.group_rounds, "True unless groups is 'types'")


@dataclasses.dataclass(frozen=True)
class ModelConfig(Checked):
    """LiDAR-Net, feature pyramid and heads (paper, section 3.4)."""

    stem: StemConfig = StemConfig()  # Modality-wise convolutions.
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of the convolutions after the first layer. Geometry, statistics, predictions, assignment and
    losses are always float32."""
    remat: bool = False
    """Recompute the activations of the stem and of the backbone's first stage in the backward pass: the same
    result with less memory and more time. Has no effect on CPUs, where XLA undoes it."""
    row_upscale: Count = 2  # Number of times each row is repeated (paper, section 4).
    circular_width: bool = False
    """Our choice: wrap every convolution around the azimuth instead of the paper's zero padding. The number of
    azimuth bins is then a multiple of 32."""
    backbone_blocks: Annotated[tuple[int, int, int, int], Bounds(1)] = (4, 4, 1, 1)  # Bottlenecks per stage.
    backbone_widths: Annotated[tuple[int, int, int, int], Bounds(1)] = (64, 128, 128, 128)
    """Bottleneck width per stage; a stage has four times as many output channels."""
    fpn_channels: Count = 256  # Our choice: channels of P2 to P7.
    head_channels: Count = 64  # Channels of both towers (128 for the test set).
    head_convs: Count = 4  # 3x3 convolutions per tower.
    tied_heads: bool = False  # Share one head between all levels (table 6).
    regression_axes: Literal["lidar", "ray"] = "lidar"
    """Axes of the predicted centre offset and velocity: the LiDAR frame's, as in equation 2, or the direction of
    the point's azimuth and the direction to its left (not in the paper)."""
    local_geometry: bool = False
    """Not in the paper: the offsets from each location's point to the points of the neighbouring pixels are an
    additional input of the heads, see ``fcos_lidar_jax.models.local_geometry``."""
    round_offsets: bool = False
    """Not in the paper: with local geometry, also the offsets from each location's point to the points of the
    later rounds in its pixel."""
    background_prior: Between = 0.99  # Our choice: initial background probability.
    channel_mean: Finite = (0.0, 0.0, -1.24, 12.5, 0.0, -0.21, 25.5, 0.0, 0.224)
    """Our choice: mean of each of ``types.CHANNELS``, subtracted in preprocessing, and of channels of your own."""
    channel_scale: Positives = (11.4, 11.4, 1.15, 10.7, 1.8, 0.19, 22.4, 1.0, 0.144)
    """Our choice: scale of each channel, by which it is divided in preprocessing."""

    def __post_init__(self) -> None:
        super().__post_init__()
        with_local = self.local_geometry or not self.round_offsets
        check(with_local, "round_offsets", self.round_offsets, "False without local_geometry")
        groups = max(1, min(32, self.head_channels // 2))  # Groups of the group norms, see models.layers.
        check(self.head_channels % groups == 0, "head_channels", self.head_channels, f"a multiple of {groups}")
        number, scales = len(self.channel_mean), self.channel_scale
        expected = f"as many numbers as channel_mean ({number}), at least nine"
        check(len(scales) == number >= 9, "channel_scale", scales, expected)


@dataclasses.dataclass(frozen=True)
class LossConfig(Checked):
    """Assignment and losses (paper, section 3.4)."""

    top_q: Count = 20  # Q: the dynamic K of a box is the rounded sum of its Q highest IoUs.
    regress_on: Literal["positives", "candidates"] = "positives"
    """Our choice: locations that box and IoU losses are averaged over: the positives, or all locations inside a
    box."""
    iou_loss: Literal["iou", "log_iou", "giou", "diou"] = "iou"
    """Our choice: 1 - IoU, UnitBox's -ln IoU, generalised IoU, or distance IoU."""
    classification_weight: Amount = 1.0  # Our choice: weight of the cross-entropy.
    l1_weight: Amount = 0.25  # Our choice: weight of the L1 loss.
    iou_weight: Amount = 1.0  # Our choice: weight of the IoU loss.
    iou_prediction_weight: Amount = 1.0  # Our choice: weight of the predicted IoU's binary cross-entropy.
    velocity_weight: Amount = 0.2  # Our choice: weight of the velocity within the L1 loss.
    refined_class_weight: Amount = 4.0
    """Weight of the second look's cross-entropy (not in the paper)."""
    refined_box_weight: Amount = 0.5  # Weight of the second look's L1 loss.
    quality: Literal["iou", "centreness"] = "iou"
    """Target of the quality prediction, by which the score is multiplied: the rotated 3D IoU, or the distance
    between predicted and true centre (not in the paper)."""
    centreness_m: Positive = 0.75  # Distance between the centres at which the centreness is 1 / e, metres.

    def __post_init__(self) -> None:
        super().__post_init__()
        width = self.centreness_m
        relevant = self.quality == "centreness" or width == LossConfig.centreness_m
        check(relevant, "centreness_m", width, f"{LossConfig.centreness_m} unless quality is centreness")


@dataclasses.dataclass(frozen=True)
class InferenceConfig(Checked):
    """Predictions to detections (paper, section 3.4)."""

    min_probability: BelowOne = 0.01  # Minimum class probability of a candidate, before the IoU factor.
    iou_threshold: Share = 0.2  # NMS removes boxes that overlap a better box of their class by more than this.
    max_detections: Count = 500  # Maximum number of boxes per cloud.
    candidates_per_level: Count = 1000  # Our choice: (location, class) pairs of each level that enter NMS.
    nms_overlap: Literal["bev", "3d"] = "bev"  # Our choice: rotated IoU in the ground plane, or in 3D.
    nms_across_classes: bool = False
    """Not in the paper: NMS also removes boxes that overlap a better box of another class. With a second look,
    only the NMS after it does."""
    iou_exponent: Amount = 1.0
    """Exponent of the predicted IoU, which multiplies the class probability: 1 in the paper; other values as in
    CIA-SSD (Zheng et al., AAAI 2021); 0 ignores the predicted IoU."""
    merge_iou: Annotated[float | None, Bounds(0, 1)] = None
    """Not in the paper: weighted NMS, which replaces a kept box by the mean of the boxes that overlap it by more
    than this, see ``nms.merge_boxes``; None disables it."""
    flips: Literal["none", "x", "y", "xy"] = "none"
    """Not in the paper: test-time augmentation by mirrored clouds; "xy" adds all three. Only flips that were used
    in training are allowed."""


@dataclasses.dataclass(frozen=True)
class RefinementConfig(Checked):
    """A second look at the points of the best boxes (not in the paper)."""

    num_boxes: Count = 200  # Best boxes of a cloud that are looked at; others are dropped.
    num_points: Count = 64  # Maximum number of points per box.
    margin_m: Amount = 1.0  # Boxes are enlarged by this on every side, metres.
    point_channels: Counts = (32, 64, 128)  # Channels of the layers on each point.
    box_channels: Counts = (128, 128)  # Channels of the layers on each box.
    num_neighbours: Natural = 16  # Nearest boxes, within 10 m, that each box is compared with; 0: none.
    pair_channels: Counts = (64, 64)  # Channels of the layers on each pair of a box and a neighbour.
    move_boxes: bool = True  # Move the boxes in detection; without, only their scores change.
    first_score_weight: Share = 0.0
    """Weight of the detector's score in the geometric mean with the second look's; 0 ignores it. The mean is
    more robust on data unlike the training's."""
    radius_range_m: Range = (1.0, 2.0)
    """Limits of the radius of an object, metres: a box whose centre is within half of the object's longer side can
    stand for it."""
    between_weight: Share = 0.3
    """Weight of boxes between one and two radii in the classification: they are neither right nor wrong."""
    freeze_detector: bool = False
    """Train only the second look; the detector is applied as in detection. For ``train --weights``."""


@dataclasses.dataclass(frozen=True)
class AugmentConfig(Checked):
    """On-device augmentation of points and boxes (paper, section 4)."""

    flip_x_probability: Share = 0.5  # Our choice: probability of x -> -x.
    flip_y_probability: Share = 0.5  # Our choice: probability of y -> -y, independent of the flip of x.
    max_rotation_rad: Amount = math.pi  # The rotation about z is uniform between minus and plus this angle.
    scale_range: Range = (0.95, 1.05)  # The scale is uniform in this range.


@dataclasses.dataclass(frozen=True)
class CopyPasteConfig(Checked):
    """Copy-paste of objects from other frames into a training frame (paper, section 4, after SECOND)."""

    targets: Annotated[tuple[int, ...], Bounds(0, empty=True)] = ()
    """Our choice: number of boxes per class up to which a frame is filled, including its own boxes; () for the
    numbers of ``classes.PASTE_TARGETS``."""
    min_points: Count = 5  # Minimum number of points of an object, over all pasted sweeps.


@dataclasses.dataclass(frozen=True)
class OptimizerConfig(Checked):
    """One-cycle AdamW (paper, section 4).

    >>> OptimizerConfig(batch_size=32, accumulate=3)
    Traceback (most recent call last):
    ValueError: accumulate: got 3, expected a divisor of the batch size 32
    """

    peak_learning_rate: Positive = 1e-2  # Learning rate at the end of the warm-up.
    initial_divisor: Positive = 10.0  # The first learning rate is the peak divided by this.
    final_divisor: Positive = 1e4  # The learning rate falls towards the first divided by this.
    warmup_fraction: Between = 0.4  # Fraction of the steps that belong to the warm-up.
    b1_range: Annotated[tuple[float, float], Bounds(0, 1, above=True, below=True, ascending=True)] = (0.85, 0.95)
    """Momentum range: high at both ends, low at the peak of the learning rate; cosine (our choice)."""
    b2: BelowOne = 0.99  # Our choice: decay of the second moment.
    weight_decay: Amount = 0.01  # Applied to all parameters (our choice).
    max_gradient_norm: Positive = 35.0  # Our choice: global-norm clipping.
    batch_size: Count = 32  # Our choice: samples per step, over all devices.
    accumulate: Count = 1
    """Micro-batches per step. Gradients and counts are summed and divided once; batch norm sees one
    micro-batch."""
    ema_decay: BelowOne = 0.0  # Decay of the moving average of the weights used for detection; 0 for none (paper).
    epochs: Count = 40  # Passes over the training set.

    def __post_init__(self) -> None:
        super().__post_init__()
        divides = self.batch_size % self.accumulate == 0
        check(divides, "accumulate", self.accumulate, f"a divisor of the batch size {self.batch_size}")


@dataclasses.dataclass(frozen=True)
class Config(Checked):
    """Definition of an FCOS-LiDAR detector and its training, without the data.

    A subclass with additional fields defines and builds another detector, see ``fcos_lidar_jax.centerpoint``.

    >>> from dataclasses import replace
    >>> paper = Config()
    >>> variant = replace(paper, projection=replace(paper.projection, num_rounds=3))
    >>> variant.projection.num_rounds, variant == paper
    (3, False)
    """

    name: str = "nuscenes"  # Name of the preset on which the configuration is based.
    sensor: str = "nuscenes_hdl32e"  # Sensor preset or path of a sensor file.
    classes: tuple[str, ...] = NUSCENES_CLASSES
    """Names of the detected classes. Each has one logit; the last logit is the background."""
    class_ranges_m: Annotated[tuple[float, ...], Bounds(0.0, above=True, empty=True)] = ()
    """Evaluation range per class, metres; () for the ranges of ``classes.RANGES_M``."""
    num_sweeps: Count = 10  # Sweeps fused into one cloud, including the current one.
    max_points: Count = 300_000  # Our choice: rows to which a fused cloud is padded.
    max_boxes: Count = 256  # Our choice: rows to which the ground truth is padded.
    fade_epochs: Natural = 0  # Last epochs without copy-paste (paper, section 4.5: 5 for the test set).
    copy_paste: CopyPasteConfig | None = CopyPasteConfig()  # Objects from the ground-truth database, or None.
    class_balanced: bool = True  # Our choice: frames are resampled so that all classes occur equally often (CBGS).
    projection: ProjectionConfig = ProjectionConfig()  # Points to range image.
    model: ModelConfig = ModelConfig()  # The network.
    loss: LossConfig = LossConfig()  # Assignment and losses.
    inference: InferenceConfig = InferenceConfig()  # Predictions to detections.
    refinement: RefinementConfig | None = None  # Not in the paper: a second look at the boxes, or None.
    augment: AugmentConfig | None = AugmentConfig()  # Augmentation in training, or None.
    optimizer: OptimizerConfig = OptimizerConfig()  # Optimizer and schedule.

    def __post_init__(self) -> None:
        super().__post_init__()
        names = self.classes
        distinct = bool(names) and all(names) and len(set(names)) == len(names)
        check(distinct, "classes", names, "one or more different names")
        stem, rounds = self.model.stem, self.projection.num_rounds
        enough = stem.group_rounds or stem.channels_per_type >= rounds
        expected = f"at least the {rounds} rounds, which are convolved separately"
        check(enough, "model.stem.channels_per_type", stem.channels_per_type, expected)
        check_per_class("class_ranges_m", self.class_ranges_m, names)
        for axis in self.inference.flips if self.inference.flips != "none" else "":
            trained = self.augment is not None and getattr(self.augment, f"flip_{axis}_probability") > 0
            check(trained, "inference.flips", self.inference.flips, f"augment.flip_{axis}_probability above 0")

    @classmethod
    def of(cls, other: "Config", **changes: Any) -> Self:
        """Create a configuration from the fields shared with another detector's configuration, with changes."""
        return cls(**{name: getattr(other, name) for name in _names(cls) & _names(other)} | changes)

    def with_doubled_classes(self, **changes: Any) -> Self:
        """Create a configuration with more classes, which shows the arrays that depend on their number."""
        more = tuple(f"{name} again" for name in self.classes)
        return dataclasses.replace(self, classes=self.classes + more, class_ranges_m=(), **changes)

    def build(self, sensor: Sensor) -> Any:
        """Build the :class:`fcos_lidar_jax.models.Detector` of a subclass; None for FCOS-LiDAR."""
        return None

    @property
    def reading(self) -> CloudReading:
        """The part of the configuration that says how to read clouds."""
        return CloudReading(self.num_sweeps, self.projection.remove_close, self.projection.close_m)

    @property
    def trains_second_look_only(self) -> bool:
        """Whether a training leaves the detector as it is."""
        return self.refinement is not None and self.refinement.freeze_detector

    @property
    def ranges_m(self) -> dict[str, float]:
        """Class -> evaluation range, metres."""
        given = self.class_ranges_m or [RANGES_M.get(name, DEFAULT_RANGE_M) for name in self.classes]
        return dict(zip(self.classes, given, strict=True))

    @property
    def paste_targets(self) -> tuple[int, ...]:
        """Number of boxes per class up to which copy-paste fills a frame; zeros without copy-paste.

        Raises:
            ValueError: the number of targets is not the number of classes. Not refused at construction, because
                the targets of a preset do not matter to ``train --classes ... --no-copy-paste``.
        """
        if self.copy_paste is None:
            return (0,) * len(self.classes)
        check_per_class("copy_paste.targets", self.copy_paste.targets, self.classes)
        by_name = tuple(PASTE_TARGETS.get(name, DEFAULT_PASTE_TARGET) for name in self.classes)
        return self.copy_paste.targets or by_name


def config_to_json(config: Config) -> dict[str, Any]:
    """Convert a configuration to a JSON object.

    >>> config_from_json(config_to_json(Config())) == Config()
    True
    """
    record = dataclasses.asdict(config)
    kind, own = _kind_of(record), type(config)
    check(kind is own, "config", kind.__name__, f"a field that only {own.__name__} has")
    return record


def _kind_of(record: Mapping[str, Any]) -> type[Config]:
    kinds: list[type[Config]] = [Config]
    for kind in kinds:
        kinds += kind.__subclasses__()
    for kind in reversed(kinds[1:]):
        if record.keys() & (_names(kind) - _names(kind.__base__)):
            return kind
    return Config


def _names(kind: Any) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)}


def config_from_json(record: Any, where: str = "config") -> Config:
    """Create a configuration from the JSON object that :func:`config_to_json` wrote.

    The fields determine the class, among the subclasses of :class:`Config` that are already imported.

    Raises:
        ValueError: naming ``where``, the field, the found and the expected value.

    >>> config_from_json({"name": "mine"}, "mine.json")
    Traceback (most recent call last):
    ValueError: mine.json: sensor: missing
    """
    kind = _kind_of(record) if isinstance(record, Mapping) else Config
    return from_json(kind, record, where)

"""A second look at the best boxes of a detector: all of their points, in the frame of each box (not in the paper).

The range view finds most objects but orders their boxes badly: the score of a pixel hardly knows the whole object.
Here a small PointNet sees the points of a box in the box's own frame, compares the box with its neighbours, scores
it anew and moves it, as in LiDAR R-CNN (Li et al., CVPR 2021) and relation networks (Hu et al., CVPR 2018). It
works on the boxes of any detector. ``Config.refinement`` switches it on.
"""

from fcos_lidar_jax.refinement.stage import (
    SECOND_LOOK,
    Boxes,
    add_refinement,
    proposal_inference,
    trainable,
    without_second_look,
)

__all__ = ["SECOND_LOOK", "Boxes", "add_refinement", "proposal_inference", "trainable", "without_second_look"]

"""HOTA of image boxes, as the KITTI tracking benchmark ranks by it.

Conventions: image boxes in pixels; the similarity is their intersection over union. What is ignored is the benchmark's
own rule (`optipmb_client.evaluation.counted`): truth boxes that are largely invisible, cut by the image's border or of
a class alike, and unmatched tracks at most 25 pixels high or in unannotated regions. The benchmark ranks cars and
pedestrians; cyclists are treated in the same way.
"""

from optipmb_client.evaluation.cases import Rules

_ALIKE = {"Car": ("Van",), "Pedestrian": ("Person", "Person_sitting")}
_MIN_HEIGHT = 25.0


def hota_2d_rules() -> Rules:
    """Return the rules for cases of image boxes."""
    return Rules("iou_2d", 0.0, continuity=False, neighbours=_ALIKE, min_height=_MIN_HEIGHT, regions=True)

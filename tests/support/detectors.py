"""Stand-ins of results of detection frameworks, with the attributes that their documentation has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

Floats = "NDArray[np.float64]"


class Tensor:
    """An array of torch: it is one of numpy after `detach`, `cpu` and `numpy`."""

    def __init__(self, values: Any) -> None:
        self.values = np.asarray(values, np.float32 if np.asarray(values).dtype.kind == "f" else np.int64)

    def detach(self) -> Tensor:
        return self

    def cpu(self) -> Tensor:
        return self

    def numpy(self) -> NDArray[Any]:
        return self.values

    def __array__(self, dtype: Any = None, *, copy: bool | None = None) -> NDArray[Any]:
        raise TypeError("can't convert a tensor of a GPU to numpy")


class LiDARInstance3DBoxes:
    """Boxes of MMDetection3D: the middle of the bottom, sizes and yaw."""

    def __init__(self, tensor: Any) -> None:
        self.tensor = Tensor(tensor)


class DepthInstance3DBoxes(LiDARInstance3DBoxes):
    """Boxes as of a LiDAR, with x right and y ahead."""


class CameraInstance3DBoxes(LiDARInstance3DBoxes):
    """Boxes in the axes of a camera."""


def openpcdet(boxes: Any, scores: Any, labels: Any) -> dict[str, Any]:
    """Give a dictionary of `post_processing` of OpenPCDet."""
    return {"pred_boxes": Tensor(boxes), "pred_scores": Tensor(scores), "pred_labels": Tensor(labels)}


def mmdet3d(boxes: Any, scores: Any, labels: Any, **more: Any) -> Any:
    """Give a `Det3DDataSample` of MMDetection3D."""
    instances = SimpleNamespace(bboxes_3d=boxes, scores_3d=Tensor(scores), labels_3d=Tensor(labels))
    return SimpleNamespace(pred_instances_3d=instances, **more)


def ultralytics(boxes: Any, scores: Any, labels: Any, shape: tuple[int, int] = (1080, 1920)) -> Any:
    """Give a `Results` of Ultralytics."""
    found = SimpleNamespace(xyxy=Tensor(boxes), conf=Tensor(scores), cls=Tensor(labels))
    return SimpleNamespace(boxes=found, obb=None, names={0: "person", 2: "car"}, orig_shape=shape)


def supervision(boxes: Any, scores: Any, labels: Any, names: Any = None) -> Any:
    """Give a `Detections` of supervision."""
    data = {} if names is None else {"class_name": np.array(names)}
    return SimpleNamespace(xyxy=np.asarray(boxes), confidence=scores, class_id=labels, data=data)

"""Generated traffic scenes."""

from optipmb_tools.datasets.scene.dataset import SceneDataset, SceneOptions, SceneSequence, scene_options

__all__ = ["SceneDataset", "SceneOptions", "SceneSequence", "scene_options"]

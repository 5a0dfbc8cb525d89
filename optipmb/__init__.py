"""OptiPMB: 3D multi-object tracking with an optimised Poisson multi-Bernoulli filter.

    import optipmb

    tracker = optipmb.OnlineTracker("kitti")
    for t, boxes in detections:
        tracks = tracker.update(boxes, t=t)

Or as a pure function, from a density and a frame to the next density and tracks:

    parameters = optipmb.load_profile("nuscenes")
    tracker = optipmb.Tracker(parameters)
    density = tracker.initial()
    for stamp_ns, boxes in detections:
        frame, _ = optipmb.make_frame(parameters, stamp_ns=stamp_ns, **boxes)
        result = tracker.step(density, frame)
        density, tracks = result.density, result.tracks

Pure computation: no files but profiles and calibrations, no network, no state outside the density.
"""

from optipmb.cameras.ground_camera import GroundCamera
from optipmb.detectors import from_detector
from optipmb.filter.detection_probability import points_in_boxes
from optipmb.filter.geometry import bev_iou
from optipmb.filter.paths import PredictedPaths, predict_tracks
from optipmb.joining.decision import Rejoin
from optipmb.joining.places import Passage
from optipmb.model.class_names import class_indices, common_name
from optipmb.model.density import Bernoullis, Density, Poissons, bytes_of, columns_in, columns_of, density_of
from optipmb.model.errors import DensityError, EffortError, FrameError, OptipmbError, ParameterError
from optipmb.model.frame import FieldOfView, Frame, PointCloud, Pose, make_frame
from optipmb.model.generic import generic_parameters
from optipmb.model.parameters import (
    Calibration,
    ClassParameters,
    HeadingSign,
    Parameters,
    ScoreCalibration,
    Sensor,
    Sensors,
    load_profile,
    parse_parameters,
    profile_source,
    profiles,
)
from optipmb.model.relocation import Relocation
from optipmb.model.tracks import Tracks, sound
from optipmb.online import OnlineTracker, OnlineTracks
from optipmb.tracker import Diagnostics, Modules, StepResult, Tracker
from optipmb.warm import warm_up
from optipmb.world.georeference import Geographic, Georeference

__version__ = "0.1.0"

__all__ = [
    "Bernoullis",
    "Calibration",
    "ClassParameters",
    "Density",
    "DensityError",
    "Diagnostics",
    "EffortError",
    "FieldOfView",
    "Frame",
    "FrameError",
    "Geographic",
    "Georeference",
    "GroundCamera",
    "HeadingSign",
    "Modules",
    "OnlineTracker",
    "OnlineTracks",
    "OptipmbError",
    "ParameterError",
    "Parameters",
    "Passage",
    "PointCloud",
    "Poissons",
    "Pose",
    "PredictedPaths",
    "Rejoin",
    "Relocation",
    "ScoreCalibration",
    "Sensor",
    "Sensors",
    "StepResult",
    "Tracker",
    "Tracks",
    "bev_iou",
    "bytes_of",
    "class_indices",
    "columns_in",
    "columns_of",
    "common_name",
    "density_of",
    "from_detector",
    "generic_parameters",
    "load_profile",
    "make_frame",
    "parse_parameters",
    "points_in_boxes",
    "predict_tracks",
    "profile_source",
    "profiles",
    "sound",
    "warm_up",
]

"""A small root in the layout of nuScenes, made up: tables, detections and scans of two scenes and more."""

import json
import math
import random
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

VERSION = "v1.0-mini"
CATEGORIES = (
    "vehicle.car",
    "human.pedestrian.child",
    "human.pedestrian.adult",
    "vehicle.bicycle",
    "vehicle.motorcycle",
    "vehicle.bus.bendy",
    "vehicle.truck",
    "vehicle.trailer",
    "vehicle.construction",
    "static_object.bicycle_rack",
)
LEVELS = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
STEP_US = 500_000
LOG = "log-0"
TILTED = [0.70, 0.01, -0.02, 0.71]


@dataclass(frozen=True)
class Thing:
    name: str
    category: str
    frame: int
    center: tuple[float, float, float]
    yaw: float = 0.0
    wlh: tuple[float, float, float] = (2.0, 4.0, 1.5)
    lidar: int = 10
    radar: int = 0
    visibility: str = "4"


@dataclass
class Scene:
    """One scene to be; the car stands at `ego` in each frame."""

    name: str
    ego: list[tuple[float, float]]
    things: list[Thing]
    start_us: int = 1_533_151_603_000_000
    jitter_us: tuple[int, ...] = ()
    """Added to the stamps of the frames, which are half a second apart."""

    def stamp(self, frame: int) -> int:
        return self.start_us + frame * STEP_US + (self.jitter_us[frame] if self.jitter_us else 0)

    def token(self, frame: int) -> str:
        return f"sample-{self.name}-{frame}"


@dataclass
class _Tables:
    rows: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def add(self, table: str, token: str, /, **fields: Any) -> None:
        self.rows.setdefault(table, []).append({"token": token, **fields})


def rotation(yaw: float) -> list[float]:
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def write_root(root: Path, scenes: list[Scene], version: str = VERSION) -> Path:
    """Write the tables of scenes below a root; give the root. Samples are not in order of time in their table."""
    tables = _Tables()
    for i, category in enumerate(CATEGORIES):
        tables.add("category", f"category-{i}", name=category, description="")
    for token, level in LEVELS.items():
        tables.add("visibility", token, level=level, description="")
    tables.add("attribute", "attribute-0", name="vehicle.moving", description="")
    for channel, modality in (("CAM_FRONT", "camera"), ("LIDAR_TOP", "lidar")):
        tables.add("sensor", f"sensor-{channel}", channel=channel, modality=modality)
        tables.add(
            "calibrated_sensor",
            f"calibrated-{channel}",
            sensor_token=f"sensor-{channel}",
            translation=[0.9, 0.0, 1.8],
            rotation=TILTED if modality == "lidar" else rotation(0.0),
            camera_intrinsic=[],
        )
    tables.add("log", LOG, logfile="log", vehicle="v", date_captured="2018-08-01", location="boston-seaport")
    tables.add("map", "map-0", category="semantic_prior", filename="maps/map.png", log_tokens=[LOG])
    for scene in scenes:
        _add_scene(tables, scene)
    folder = root / version
    folder.mkdir(parents=True)
    for name in ("sample", "sample_data"):
        tables.rows[name].reverse()
    for name in ("instance", "sample_annotation"):
        tables.rows.setdefault(name, [])
    for name, rows in tables.rows.items():
        (folder / f"{name}.json").write_text(json.dumps(rows, indent=0))
    (root / "maps").mkdir(exist_ok=True)
    (root / "maps" / "map.png").write_bytes(b"")
    return root


def _add_scene(tables: _Tables, scene: Scene) -> None:
    last = len(scene.ego) - 1
    tables.add(
        "scene",
        f"scene-token-{scene.name}",
        log_token=LOG,
        nbr_samples=len(scene.ego),
        first_sample_token=scene.token(0),
        last_sample_token=scene.token(last),
        name=scene.name,
        description="",
    )
    for frame, (x, y) in enumerate(scene.ego):
        token = scene.token(frame)
        tables.add(
            "sample",
            token,
            timestamp=scene.stamp(frame),
            prev=scene.token(frame - 1) if frame else "",
            next=scene.token(frame + 1) if frame < last else "",
            scene_token=f"scene-token-{scene.name}",
        )
        scans = [("CAM_FRONT", True), ("LIDAR_TOP", True), ("LIDAR_TOP", False)]
        for channel, key in scans if frame % 2 else scans[::-1]:
            name = f"{channel}-{scene.name}-{frame}{'' if key else '-sweep'}"
            tables.add("ego_pose", f"ego-{name}", timestamp=0, rotation=rotation(0.3), translation=[x, y, 0.0])
            tables.add(
                "sample_data",
                f"data-{name}",
                sample_token=token,
                ego_pose_token=f"ego-{name}",
                calibrated_sensor_token=f"calibrated-{channel}",
                timestamp=scene.stamp(frame) + (0 if key else 50_000),
                fileformat="pcd",
                is_key_frame=key,
                height=0,
                width=0,
                filename=f"{'samples' if key else 'sweeps'}/{channel}/{name}.pcd.bin",
                prev="",
                next="",
            )
    _add_things(tables, scene)


def _add_things(tables: _Tables, scene: Scene) -> None:
    tokens = {}
    by_name: dict[str, list[Thing]] = {}
    for i, thing in enumerate(scene.things):
        tokens[thing.name, thing.frame] = f"annotation-{scene.name}-{i}"
        by_name.setdefault(thing.name, []).append(thing)
    for name, life in by_name.items():
        life.sort(key=lambda thing: thing.frame)
        tables.add(
            "instance",
            f"instance-{scene.name}-{name}",
            category_token=f"category-{CATEGORIES.index(life[0].category)}",
            nbr_annotations=len(life),
            first_annotation_token=tokens[name, life[0].frame],
            last_annotation_token=tokens[name, life[-1].frame],
        )
    for thing in scene.things:
        life = by_name[thing.name]
        at = life.index(thing)
        tables.add(
            "sample_annotation",
            tokens[thing.name, thing.frame],
            sample_token=scene.token(thing.frame),
            instance_token=f"instance-{scene.name}-{thing.name}",
            visibility_token=thing.visibility,
            attribute_tokens=[],
            translation=list(thing.center),
            size=list(thing.wlh),
            rotation=rotation(thing.yaw),
            prev=tokens[thing.name, life[at - 1].frame] if at else "",
            next=tokens[thing.name, life[at + 1].frame] if at + 1 < len(life) else "",
            num_lidar_pts=thing.lidar,
            num_radar_pts=thing.radar,
        )


def write_detections(
    root: Path, name: str, scenes: list[Scene], boxes: dict[str, list[dict[str, Any]]] | None = None
) -> Path:
    """Write a detection file: the given boxes by sample token, and an empty list for every other sample."""
    results = {scene.token(frame): [] for scene in scenes for frame in range(len(scene.ego))} | (boxes or {})
    path = root / "detections" / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    meta = {"use_camera": True, "use_lidar": True, "use_radar": False, "use_map": False, "use_external": False}
    path.write_text(json.dumps({"meta": meta, "results": results}))
    return path


def box(token: str, **changes: Any) -> dict[str, Any]:
    values = {
        "sample_token": token,
        "translation": [10.0, 20.0, 1.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": rotation(0.5),
        "velocity": [1.0, 2.0],
        "detection_name": "car",
        "detection_score": 0.5,
        "attribute_name": "",
    }
    return values | changes


def write_scan(root: Path, filename: str, points: NDArray[np.float32]) -> None:
    path = root / filename
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(points.astype("<f4").tobytes())


def crowd(name: str, seed: int, frames: int = 15, start_us: int = 1_533_151_603_000_000) -> Scene:
    """Give a scene with objects of all kinds that come and go, unseen ones, holes, and a rack with bicycles in it."""
    chance = random.Random(seed)
    ego = [(600.0 + 3.0 * frame, 1600.0 + 0.5 * frame) for frame in range(frames)]
    things = []
    for number in range(40):
        category = CATEGORIES[number % (len(CATEGORIES) - 1)]
        x, y = 620.0 + chance.uniform(-60, 60), 1603.0 + chance.uniform(-40, 40)
        vx, vy = (chance.uniform(-4, 4), chance.uniform(-4, 4)) if number % 3 else (0.0, 0.0)
        begin = chance.randrange(frames)
        end = chance.randrange(begin, frames)
        for frame in range(begin, end + 1):
            if chance.random() < 0.1:
                continue
            points = 0 if chance.random() < 0.15 else chance.randrange(1, 200)
            things.append(
                Thing(
                    name=f"thing-{number}",
                    category=category,
                    frame=frame,
                    center=(x + 0.5 * vx * frame, y + 0.5 * vy * frame, 1.0),
                    yaw=math.atan2(vy, vx),
                    lidar=points,
                    radar=int(chance.random() < 0.1),
                    visibility=chance.choice(["", *LEVELS]),
                )
            )
    for i, kind in enumerate(("vehicle.bicycle", "vehicle.motorcycle", "vehicle.bicycle")):
        things += [Thing(f"parked-{i}", kind, frame, (615.0 + 2.0 * i, 1610.0, 1.0)) for frame in range(frames)]
    for frame in range(0, frames, 2):
        size = (2.0, 5.0, 3.0)
        things.append(Thing("rack", CATEGORIES[-1], frame, (616.0, 1610.0, 1.0), yaw=0.1, wlh=size))
    chance.shuffle(things)
    jitter = tuple(chance.randrange(-60_000, 60_000) for _ in range(frames))
    return Scene(name, ego, things, start_us, jitter)

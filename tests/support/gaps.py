"""Generated scenes whose objects are hidden for seconds: detections with the object of each, tracks, and true gaps.

A street behind buildings, a car park, a sensor that turns to and fro, and a square with kiosks; 10 Hz. Objects also
end and begin behind what hides them, stop, and leave their slot to another one.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import Tracks
from optipmb_tools.run.rejoining import RejoinOptions
from optipmb_tools.run.tracking import fields_of

import optipmb
from optipmb.model.lost_objects import Tracklets

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
RATE: Final = 10
CLASSES: Final = ("car", "pedestrian", "bicycle")
SIZES: Final = np.array([[4.4, 1.85, 1.55], [0.7, 0.65, 1.74], [1.8, 0.65, 1.74]])
SPREAD: Final = np.array([[0.09, 0.05, 0.06], [0.1, 0.1, 0.05], [0.05, 0.05, 0.05]])
PLACE: Final = np.array([0.12, 0.06, 0.08])
"""White error of detected places, m; errors that last are twice as large for cars."""
FALSE: Final = 0.3
"""False detections in a frame."""
FALSE_OBJECT: Final = -1
END: Final = 5
"""Detections at an end of a track that tell on which object it is."""


@dataclass
class Scene:
    """Paths of objects, and what hides them."""

    seconds: float
    rng: np.random.Generator
    boxes: list[tuple[float, float, float, float]] = field(default_factory=list)  # x, y from and to, of buildings
    label: list[int] = field(default_factory=list)
    first: list[int] = field(default_factory=list)  # frame
    path: list[Floats] = field(default_factory=list)  # (F, 2)
    yaw: list[Floats] = field(default_factory=list)
    dark: list[NDArray[np.bool_]] = field(default_factory=list)  # frames without detections
    heading: Callable[[int], float] | None = None  # of a sensor of 120 degrees
    region: tuple[float, float, float, float] = (-40.0, -5.0, 40.0, 30.0)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return round(self.seconds * RATE)

    def add(self, label: int, first: int, path: Floats, yaw: Floats | float, dark: Any = None) -> None:
        """Add an object with places (F, 2) from a frame on; frames before the start or after the end are cut."""
        begin, end = max(0, -first), min(len(path), self.frames - first)
        if end - begin < 2:
            return
        self.label.append(label)
        self.first.append(max(first, 0))
        self.path.append(path[begin:end])
        self.yaw.append(np.broadcast_to(yaw, len(path))[begin:end])
        self.dark.append(np.zeros(end - begin, np.bool_) if dark is None else np.asarray(dark)[begin:end])

    def hidden(self, place: Floats) -> NDArray[np.bool_]:
        """Return whether the line from the sensor, at the origin, to places (N, 2) crosses a building."""
        found = np.zeros(len(place), dtype=np.bool_)
        way = np.where(np.abs(place) < 1e-9, 1e-9, place)
        for x0, y0, x1, y1 in self.boxes:
            a, b = np.array((x0, y0)) / way, np.array((x1, y1)) / way
            enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            found |= np.maximum(enter, 0.0) < np.minimum(leave, 1.0)
        return found


def _walk(rng: np.random.Generator, count: int, speed: float, spread: float, memory: float) -> Floats:
    """Return speeds (F,) that vary around a mean."""
    keep = np.exp(-1.0 / (RATE * memory))
    noise, found = rng.standard_normal(count) * spread * np.sqrt(1.0 - keep**2), np.empty(count)
    found[0] = spread * rng.standard_normal()
    for k in range(1, count):
        found[k] = keep * found[k - 1] + noise[k]
    return np.maximum(speed + found, 0.1 * speed)


def _along(rng: np.random.Generator, lane: tuple[Floats, Floats], speed: float, spread: float) -> tuple[Floats, Floats]:
    """Return places (F, 2) and headings of an object that goes from one end of a lane to the other."""
    start, end = lane
    length = float(np.linalg.norm(end - start))
    way = np.concatenate(([0.0], np.cumsum(_walk(rng, round(3 * RATE * length / speed), speed, spread, 4.0)) / RATE))
    way = way[way < length]
    ahead = (end - start) / length
    aside = 0.15 * np.cumsum(rng.standard_normal(len(way))) / np.sqrt(RATE * 10.0)
    place = start + way[:, None] * ahead + aside[:, None] * (-ahead[1], ahead[0])
    return place, np.full(len(way), np.arctan2(ahead[1], ahead[0]))


def _traffic(scene: Scene, lanes: list[tuple[int, Floats, Floats, float, float]], every: float, lost: float) -> None:
    """Let objects arrive on lanes; the share `lost` ends somewhere on the way, and as many begin there."""
    rng = scene.rng
    for label, start, end, speed, spread in lanes:
        clock = -40.0
        while clock < scene.seconds:
            place, yaw = _along(rng, (start, end), speed * rng.uniform(0.8, 1.2), spread)
            kind = rng.random()
            cut = int(rng.uniform(0.3, 0.7) * len(place))
            first = round(clock * RATE)
            if kind < lost:
                place, yaw = place[:cut], yaw[:cut]
            elif kind < 2 * lost:
                place, yaw, first = place[cut:], yaw[cut:], first + cut
            elif kind < 2.5 * lost and len(place) > cut:  # stops for a while
                stop = np.full(round(rng.uniform(3.0, 8.0) * RATE), cut)
                order = np.concatenate((np.arange(cut), stop, np.arange(cut, len(place))))
                place, yaw = place[order], yaw[order]
            scene.add(label, first, place, yaw)
            clock += max(rng.exponential(every), 12.0 / speed)


def street(seconds: float, rng: np.random.Generator) -> Scene:
    """Return a street behind three buildings, with a parked row on its far side."""
    scene = Scene(seconds, rng, boxes=[(-20.0, 4.5, -13.0, 5.5), (-4.0, 4.5, 2.0, 5.5), (11.0, 4.5, 19.0, 5.5)])
    lanes = [(0, np.array((-45.0, y)), np.array((45.0, y)), 9.0, 1.0) for y in (9.0, 12.5)]
    lanes += [(0, np.array((45.0, y)), np.array((-45.0, y)), 9.0, 1.0) for y in (16.0, 19.5)]
    lanes += [(2, np.array((45.0, 22.0)), np.array((-45.0, 22.0)), 4.5, 0.5)]
    _traffic(scene, lanes, 6.0, 0.1)
    walks = [(1, np.array((-35.0, y)), np.array((35.0, y)), 1.4, 0.15) for y in (7.0, 26.0)]
    walks += [(1, np.array((35.0, y)), np.array((-35.0, y)), 1.4, 0.15) for y in (7.8, 26.8)]
    _traffic(scene, walks, 12.0, 0.1)
    for x in np.arange(-30.0, 31.0, 6.0):
        _park(scene, np.array((x, 24.0)) + 0.2 * rng.standard_normal(2), np.pi, mean=(60.0, 2.0))
    return scene


def _park(scene: Scene, place: Floats, yaw: float, mean: tuple[float, float], leaves: float = 0.0) -> None:
    """Add a parked car that is detected and not detected by turns, of mean durations, and may leave its slot."""
    rng, first = scene.rng, 0
    while first < scene.frames:
        stays = round(min(rng.exponential(leaves), 1e4) * RATE) if leaves else scene.frames
        stays = min(stays, scene.frames - first)
        dark = np.concatenate([
            np.full(max(1, round(rng.exponential(mean[k % 2]) * RATE)), bool(k % 2))
            for k in range(2 * scene.frames // round(sum(mean) * 2) + 40)
        ])  # fmt: skip
        dark = np.resize(dark, stays + 60)
        drive = np.cumsum(np.minimum(0.15 * np.arange(60) / RATE * 10.0, 4.0)) / RATE
        path = np.concatenate((np.tile(place, (stays, 1)), place + drive[:, None] * (np.cos(yaw), np.sin(yaw))))
        dark[stays:] &= rng.random() < 0.3  # most are seen to drive off
        scene.add(0, first, path, yaw, dark)
        first += stays + 60 + round(rng.exponential(6.0) * RATE)


def car_park(seconds: float, rng: np.random.Generator) -> Scene:
    """Return two double rows of parked cars whose detections drop out; some slots change their owner."""
    scene = Scene(seconds, rng)
    for row, y in enumerate((6.0, 18.0, 24.0)):
        for x in np.arange(-27.0, 28.0, 3.0):
            if rng.random() < 0.7:
                yaw = np.pi / 2 * (1 if row else -1)
                leaves = 80.0 if rng.random() < 0.3 else 0.0
                _park(scene, np.array((x, y)) + 0.15 * rng.standard_normal(2), yaw, (14.0, 2.5), leaves)
    lanes = [(0, np.array((-40.0, 11.0)), np.array((40.0, 11.0)), 4.0, 0.6)]
    lanes += [(1, np.array((-30.0, 13.0)), np.array((30.0, 13.0)), 1.3, 0.15)]
    _traffic(scene, lanes, 15.0, 0.15)
    return scene


def turning_sensor(seconds: float, rng: np.random.Generator) -> Scene:
    """Return a crossing as a sensor of 120 degrees sees it that turns to and fro by 70 degrees."""
    scene = Scene(seconds, rng, region=(-40.0, -40.0, 40.0, 40.0))
    scene.heading = lambda frame: 1.2 * np.sin(2.0 * np.pi * frame / (RATE * 16.0))
    lanes = [(0, np.array((x, -45.0 * way)), np.array((x, 45.0 * way)), 7.0, 1.0) for x, way in ((12.0, 1), (16.0, -1))]
    lanes += [(2, np.array((20.0, 45.0)), np.array((20.0, -45.0)), 4.5, 0.5)]
    _traffic(scene, lanes, 7.0, 0.1)
    walks = [(1, np.array((x, -30.0 * way)), np.array((x, 30.0 * way)), 1.4, 0.15) for x, way in ((8.0, 1), (23.0, -1))]
    _traffic(scene, walks, 10.0, 0.1)
    for y in np.arange(-28.0, 29.0, 7.0):
        _park(scene, np.array((26.0, y)) + 0.2 * rng.standard_normal(2), np.pi / 2, mean=(60.0, 1.0))
    return scene


def _border(rng: np.random.Generator) -> Floats:
    """Return a point on the border of the square."""
    x, y = rng.uniform((-20.0, 4.0), (20.0, 26.0))
    aside, end = rng.random() < 0.35, rng.random() < 0.5
    return np.array((20.0 - 40.0 * end, y) if aside else (x, 4.0 + 22.0 * end))


def square(seconds: float, rng: np.random.Generator) -> Scene:
    """Return 55 people who cross a square with six kiosks from side to side, and some of them rest at its border."""
    kiosks = [(x - 1.2, y - 0.8, x + 1.2, y + 0.8) for x in (-12.0, 0.0, 12.0) for y in (9.0, 17.0)]
    scene = Scene(seconds, rng, boxes=kiosks, region=(-22.0, 3.0, 22.0, 27.0))
    for _ in range(55):
        place, points = rng.uniform((-20.0, 4.0), (20.0, 26.0)), []
        speed, turned = rng.uniform(1.0, 1.6), rng.uniform(-np.pi, np.pi)
        target = _border(rng)
        rests, yaws, side = 0, [], rng.choice((-1.0, 1.0))
        for _ in range(scene.frames):
            if rests:
                rests -= 1
            else:
                wanted = np.arctan2(*(target - place)[::-1])
                turned += np.clip(np.angle(np.exp(1j * (wanted - turned))), -0.15, 0.15) + 0.03 * rng.standard_normal()
                ahead = place + speed / RATE * np.array((np.cos(turned), np.sin(turned)))
                if any(x0 - 0.4 < ahead[0] < x1 + 0.4 and y0 - 0.4 < ahead[1] < y1 + 0.4 for x0, y0, x1, y1 in kiosks):
                    turned += 0.4 * side
                    side = side if rng.random() < 0.95 else -side
                else:
                    place = ahead
                if np.linalg.norm(target - place) < 0.7:
                    target = _border(rng)
                    rests = round(rng.uniform(2.0, 8.0) * RATE) if rng.random() < 0.3 else 0
            points.append(place)
            yaws.append(turned)
        scene.add(1, 0, np.array(points), np.array(yaws))
    return scene


DOORS: Final = (-8.0, 8.0)
"""Centres of the doors in a wall, m."""


def doors(seconds: float, rng: np.random.Generator) -> Scene:
    """Return two doors in a wall: some people go in, others come out, and others pass by, behind a pillar."""
    scene = Scene(seconds, rng, boxes=[(-0.7, 5.0, 0.7, 6.0)], region=(-22.0, 3.0, 22.0, 15.0))
    for x in DOORS:
        clock = rng.uniform(-10.0, 0.0)
        while clock < seconds:
            for way in (-1, 1):
                door = np.array((x + rng.uniform(-0.6, 0.6), 12.0 + rng.uniform(-0.3, 0.3)))
                turn = rng.uniform(-2.7, -0.4)
                away = door + 14.0 * np.array((np.cos(turn), 0.5 * np.sin(turn)))
                ends = (door, away) if way > 0 else (away, door)
                place, yaw = _along(rng, ends, 1.4 * rng.uniform(0.8, 1.2), 0.15)
                scene.add(1, round(clock * RATE), place, yaw)
                clock += len(place) / RATE + rng.uniform(2.0, 10.0) if way < 0 else rng.exponential(6.0)
    walks = [(1, np.array((-20.0 * way, 8.0)), np.array((20.0 * way, 8.0)), 1.4, 0.15) for way in (-1, 1)]
    _traffic(scene, walks, 12.0, 0.0)
    return scene


def corridor(seconds: float, rng: np.random.Generator) -> Scene:
    """Return people in a corridor, both ways, of whom none is seen on 24 m in its middle; one in ten goes elsewhere."""
    scene = Scene(seconds, rng, region=(-25.0, 3.0, 25.0, 10.0))
    for way in (-1, 1):
        clock = -40.0
        while clock < seconds:
            y = 6.5 - way + rng.uniform(-0.5, 0.5)
            lane = np.array((-25.0 * way, y)), np.array((25.0 * way, y))
            place, yaw = _along(rng, lane, 1.4 * rng.uniform(0.8, 1.2), 0.15)
            first, kind, half = round(clock * RATE), rng.random(), len(place) // 2
            if kind < 0.1:
                place, yaw = (place[:half], yaw[:half]) if kind < 0.05 else (place[half:], yaw[half:])
                first += half * (kind >= 0.05)
            scene.add(1, first, place, yaw, np.abs(place[:, 0]) < 12.0)
            clock += 4.0 + rng.exponential(12.0)
    return scene


SCENES: Final = {"street": street, "car park": car_park, "turning sensor": turning_sensor, "square": square}
SITES: Final = {"doors": doors, "corridor": corridor}
"""Scenes in which something may be declared, and"""


def _box(x0: float, y0: float, x1: float, y1: float) -> tuple[tuple[float, float], ...]:
    return (x0, y0), (x1, y0), (x1, y1), (x0, y1)


DECLARED: Final[dict[str, dict[str, Any]]] = {
    "doors": {"exits": tuple(_box(x - 2.0, 10.5, x + 2.0, 13.0) for x in DOORS)},
    "corridor": {
        "passages": tuple(
            optipmb.Passage(_box(*min(a, b), *max(a, b)), _box(*min(c, d), *max(c, d)), (10.0, 30.0))
            for way in (-1, 1)
            for a, b, c, d in [((-16.0 * way, 4.0), (-11.0 * way, 9.0), (11.0 * way, 4.0), (16.0 * way, 9.0))]
        )
    },
}
"""what it is, as arguments of `optipmb.Rejoin`."""


@dataclass(frozen=True)
class Recording:
    """The detections and the truth of a scene."""

    frames: list[dict[str, Any]]  # arguments of `make_frame`
    source: list[Ints]  # object of each detection, or `FALSE_OBJECT`
    truth: list[tuple[Ints, Floats]]  # objects that can be seen in each frame, and their places (N, 2)
    labels: dict[int, int]  # of the objects


def record(name: str, seed: int, seconds: float = 120.0) -> Recording:
    """Return what a detector sees of a scene."""
    scenes = SCENES | SITES
    rng = np.random.Generator(np.random.PCG64([seed, list(scenes).index(name)]))
    scene = scenes[name](seconds, rng)
    label = np.array(scene.label)
    size = SIZES[label] * np.exp(SPREAD[label] * rng.standard_normal((len(label), 3)))
    bias, lasting = 0.05 * rng.standard_normal((len(label), 3)), np.zeros((len(label), 2))
    frames, sources, truths = [], [], []
    first, last = np.array(scene.first), np.array(scene.first) + [len(one) for one in scene.path]
    for k in range(scene.frames):
        here = np.flatnonzero((first <= k) & (k < last))
        place = np.array([scene.path[n][k - first[n]] for n in here]).reshape(-1, 2)
        yaw = np.array([scene.yaw[n][k - first[n]] for n in here])
        seen = ~scene.hidden(place) & ~np.array([scene.dark[n][k - first[n]] for n in here], dtype=np.bool_)
        if scene.heading is not None:
            aside = np.angle(np.exp(1j * (np.arctan2(place[:, 1], place[:, 0]) - scene.heading(k))))
            seen &= np.abs(aside) < np.pi / 3.0
        lasting = 0.95 * lasting + np.sqrt(1.0 - 0.95**2) * PLACE[label][:, None] * rng.standard_normal(lasting.shape)
        truths.append((here[seen], place[seen]))
        found = np.flatnonzero(seen & (rng.random(len(here)) < 0.92))
        own, count = here[found], int(rng.poisson(FALSE))
        noise = PLACE[label[own]][:, None] * rng.standard_normal((len(own), 2)) + lasting[own]
        x0, y0, x1, y1 = scene.region
        kinds = np.concatenate((label[own], rng.integers(0, 3, count)))
        boxes = size[own] * np.exp(bias[own] + 0.03 * rng.standard_normal((len(own), 3)))
        boxes = np.concatenate((boxes, SIZES[kinds[len(own) :]]))
        center = np.concatenate((place[found] + noise, rng.uniform((x0, y0), (x1, y1), (count, 2))))
        turned = yaw[found] + np.where(label[own] == 1, 0.25, 0.05) * rng.standard_normal(len(own))
        turned = np.concatenate((turned, rng.uniform(-np.pi, np.pi, count)))
        score = np.concatenate((rng.beta(8.0, 2.0, len(own)), rng.beta(2.0, 6.0, count)))
        sources.append(np.concatenate((own, np.full(count, FALSE_OBJECT))))
        frames.append({
            "stamp_ns": k * 10**9 // RATE,
            "labels": CLASSES,
            "center": np.column_stack((center, 0.5 * boxes[:, 2])),
            "size": boxes,
            "yaw": np.angle(np.exp(1j * turned)),
            "score": np.clip(score, 0.05, 0.99),
            "label": kinds.astype(np.int64),
        })  # fmt: skip
    return Recording(frames, sources, truths, dict(enumerate(label.tolist())))


def with_vectors(
    recording: Recording, view: float, seed: int = 0, numbers: int = 32, *, lasts: bool = False
) -> list[dict[str, Any]]:
    """Return the frames of a recording with simulated vectors of appearance.

    Each object has a direction of its own. To it come a part of the length `view` that changes with a time constant of
    3 s, as the side from which it is seen, and white noise. With 1.6, 1.25 and 0.85 the equal error rate of the vectors
    of two tracks is 20, 12 and 3 % after a long gap. With `lasts` that part changes only while an object is not
    detected for a second or more.
    """
    rng = np.random.Generator(np.random.PCG64([seed, numbers]))
    count, keep = len(recording.labels), np.exp(-1.0 / (3.0 * RATE))
    own, sides = rng.standard_normal((2, count + 1, numbers))
    frames, seen = [], np.full(count + 1, -RATE)
    for k, (given, source) in enumerate(zip(recording.frames, recording.source, strict=True)):
        other = rng.standard_normal(sides.shape)
        away = (k - seen >= RATE)[:, None]
        sides = np.where(away, other, sides) if lasts else keep * sides + np.sqrt(1.0 - keep**2) * other
        seen[source] = k
        own[-1] = rng.standard_normal(numbers)  # of a false detection
        vectors = own[source] + view * sides[source] + 0.7 * rng.standard_normal((len(source), numbers))
        frames.append(given | {"embedding": vectors.astype(np.float32), "embedding_model": "reid-7"})
    return frames


def cars(*paths: tuple[float, float, tuple[float, float], tuple[float, float]]) -> list[dict[str, Any]]:
    """Return frames over 10 s of cars, each given from and until a time, with its first place and its velocity."""
    frames = []
    for k in range(100):
        here = [(place, way) for begin, end, place, way in paths if begin <= k / 10 < end]
        center = np.array([(x + vx * k / 10, y + vy * k / 10, 0.8) for (x, y), (vx, vy) in here]).reshape(-1, 3)
        yaw = np.array([np.arctan2(vy, vx) for _, (vx, vy) in here])
        count = len(here)
        given = {
            "stamp_ns": k * 10**8,
            "labels": CLASSES,
            "center": center,
            "yaw": yaw,
            "score": np.full(count, 0.9),
        }
        frames.append(given | {"size": np.tile(SIZES[0], (count, 1)), "label": np.zeros(count, np.int64)})
    return frames


def tracked(
    frames: list[dict[str, Any]], parameters: optipmb.Parameters, how: optipmb.Rejoin | None = None
) -> dict[int, Tracks]:
    """Return the tracks of each frame, given by the arguments of `make_frame`, as messages."""
    return followed((optipmb.make_frame(parameters, **given)[0] for given in frames), parameters, how)


def followed(
    frames: Iterable[optipmb.Frame], parameters: optipmb.Parameters, how: optipmb.Rejoin | None = None
) -> dict[int, Tracks]:
    """Return the tracks of each frame as messages, with their objects if they are joined while tracking."""
    tracker = optipmb.Tracker(parameters, rejoin=how)
    density, found = tracker.initial(), {}
    for k, frame in enumerate(frames):
        result = tracker.step(density, frame)
        density, joined = result.density, result.joined
        header = {"stream": "a/b/c", "epoch": bytes(16), "seq": k, "stamp_ns": frame.stamp_ns, "session": "0" * 32}
        header |= {"profile": parameters.name, "cloud_used": False, "labels": parameters.labels}
        others: dict[str, Any] = {"measured": result.measured}
        if joined is not None:
            others |= {"object": joined.object, "object_probability": joined.probability}
        found[k] = Tracks.trusted(header | fields_of(result.tracks, None, **others))
    return found


def decided(tracks: dict[int, Tracks], found: Tracklets) -> tuple[Ints, Ints, Floats]:
    """Return the joins of a tracker: rows of the earlier and of the later tracks, and their probabilities."""
    row = dict(zip(found.id.tolist(), range(len(found)), strict=True))
    newest: dict[int, tuple[int, float]] = {}  # track of each object, and the probability of its chain
    before, after, probability = [], [], []
    for one in tracks.values():
        if one.object is None or one.object_probability is None:
            raise ValueError("tracks without objects")
        columns = one.id.tolist(), one.object.tolist(), one.object_probability.tolist()
        for identity, number, product in zip(*columns, strict=True):
            last, chain = newest.get(number, (identity, 1.0))
            if number < 0 or (last == identity and number in newest):
                continue
            newest[number] = identity, product
            if last != identity:
                before.append(row[last])
                after.append(row[identity])
                probability.append(product / chain)
    return np.array(before, dtype=np.int64), np.array(after, dtype=np.int64), np.array(probability)


def owners(tracks: dict[int, Tracks], source: list[Ints]) -> dict[int, tuple[int, int]]:
    """Return the objects on which each track began and ended."""
    rows: dict[int, list[int]] = {}
    for k, one in tracks.items():
        for identity, detection in zip(one.id.tolist(), one.detection.tolist(), strict=True):
            if detection >= 0:
                rows.setdefault(identity, []).append(int(source[k][detection]))
    return {identity: ends_of(own) for identity, own in rows.items()}


def ends_of(objects: list[int]) -> tuple[int, int]:
    """Return the objects of most of the first and of the last `END` detections of a track.

    A single detection at an end may be a false one, or of an object that passes through this one.
    """
    (first,), (last,) = (Counter(own).most_common(1) for own in (objects[:END], objects[: -END - 1 : -1]))
    return first[0], last[0]


@dataclass(frozen=True)
class Judged:
    """True gaps of at most `gap_s`, and joins, of some recordings; results add up."""

    gap: Floats = field(default_factory=lambda: np.empty((0, 2)))  # (G, 2) length, s, and the probability of its join
    join: Floats = field(default_factory=lambda: np.empty((0, 2)))
    """(J, 2) probability, and 1 of a right, 0 of a wrong one, NaN of tracks on nothing that is labelled."""

    def __add__(self, other: "Judged") -> "Judged":
        return Judged(np.concatenate((self.gap, other.gap)), np.concatenate((self.join, other.join)))

    def counts(self, least: float) -> tuple[int, int, int]:
        """Return the numbers of right, wrong and unlabelled joins from a probability on."""
        right = self.join[self.join[:, 0] >= least, 1]
        return int((right == 1.0).sum()), int((right == 0.0).sum()), int(np.isnan(right).sum())

    def share(self, low: float, high: float, least: float) -> tuple[float, int]:
        """Return the share of the gaps of these lengths that is joined, and their number."""
        rows = (self.gap[:, 0] >= low) & (self.gap[:, 0] < high)
        return float(np.mean(self.gap[rows, 1] >= least)) if rows.any() else np.nan, int(rows.sum())


def judge(
    found: Tracklets,
    joined: tuple[Ints, Ints, Floats],
    owner: dict[int, tuple[int, int]],
    *,
    whole: bool = True,
) -> Judged:
    """Return the true gaps of a recording and its joins, of any probability.

    A join is right if the earlier track ended on the object on which the later one began. Without `whole` annotations,
    an object may lack one.
    """
    before, after, probability = joined
    by = dict(zip(zip(before.tolist(), after.tolist(), strict=True), probability.tolist(), strict=True))
    begun, ended = (np.array([owner[one][end] for one in found.id.tolist()], dtype=np.int64) for end in (0, 1))
    gaps = []
    for j in np.flatnonzero(begun != FALSE_OBJECT).tolist():
        gap = (found.first_ns[j] - found.last_ns) * 1e-9
        same = np.flatnonzero((ended == begun[j]) & (gap > 0.0) & (gap <= RejoinOptions.gap_s))
        if len(same):
            i = int(same[gap[same].argmin()])
            gaps.append((gap[i], by.get((i, j), 0.0)))
    right = (ended[before] == begun[after]).astype(np.float64)
    nothing = ended[before] == FALSE_OBJECT, begun[after] == FALSE_OBJECT
    right[nothing[0] & nothing[1] if whole else nothing[0] | nothing[1]] = np.nan
    return Judged(np.array(gaps).reshape(-1, 2), np.column_stack((probability, right)))

"""The same object after a gap: which new track continues which lost one (not in the paper).

The log ratio of "track j continues track i" and "j is a new object" is

    s_ij = log [P f(T) p(y, w | i, T) p(size_j | size_i)] - log [lambda(y) p(w | new) p(size_j | class)]

with the motion and the sizes of `optipmb.joining.evidence`, and the rate of new objects lambda of
`optipmb.joining.places`, where exits and passages change it.

The joins are the matching of ends and beginnings with the largest sum of positive s_ij. A join has the probability
1 / (1 + exp(-m)) with the margin m: the largest sum less the largest one without that pair. Two equal candidates have
one half each.

`Rejoining` is the state of a tracker that joins while it tracks: it decides on a track when it is confirmed and was
detected for `Rejoin.decide_s`. `optipmb track --rejoin` joins the tracks of a recording by the same scores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.joining.appearance import NOTHING, Vectors, aligned, appearance_score, count_distance, seen
from optipmb.joining.evidence import (
    QUANTUM,
    KnownTexts,
    attribute_score,
    count_sizes,
    log_sum,
    motion_of,
    pair_score,
    size_score,
)
from optipmb.joining.following import PLACE_COLUMNS, TRACKLETS, follow
from optipmb.joining.matching import match
from optipmb.joining.places import (
    BY_END,
    MOST_CORNERS,
    MOST_SHAPES,
    RECENT_NS,
    DeclaredPlaces,
    Passage,
    Polygon,
    beginnings_around,
    ends_around,
    in_exit,
    learned_score,
    passage_score,
    return_score,
    with_beginnings,
    with_ends,
    with_returns,
)
from optipmb.joining.records import beginnings_in, ends_in, returns_in, selected, statistics_in, tracklets_in
from optipmb.model.attributes import Attributes, gathered
from optipmb.model.errors import ParameterError
from optipmb.model.frame import LONGEST_MODEL
from optipmb.model.lost_objects import Beginnings, Ends, Lost, Places, Rejoining, Returns, Statistics, Tracklets
from optipmb.model.polygons import check_polygon
from optipmb.model.tracks import Tracks, tracks_in

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.density import Density
    from optipmb.model.frame import Embedding
    from optipmb.model.parameters import Parameters
    from optipmb.model.rows import Array, Columns, Index

    Flags = NDArray[np.bool_]

SURE: Final = 4.6
"""Score from which a pair is sure by motion alone, above 0 and above all others of both tracks."""
RIVAL_NS: Final = 3 * 10**9
"""Tracks that began so lately compete for lost objects."""
LEAST_SIZES: Final = 5
"""Tracks of a class from which its sizes count while tracking."""
MOST_SCORES: Final = 20_000
"""Most pairs that are scored in a frame; the longest lost objects are left out first."""
MOST_PAIRS: Final = 4000
"""Most pairs of the matching of a frame; the lowest scores are left out first."""
_NS: Final = 1e-9
_NONE: Final = np.zeros(0, np.int64)

_BOUNDS: Final = MappingProxyType(
    {
        "gap_s": (math.nextafter(0.0, 1.0), 600.0, "a time in (0, 600] s"),
        "min_probability": (0.5, math.nextafter(1.0, 0.0), "a number in [0.5, 1)"),
        "decide_s": (0.0, 5.0, "a time in [0, 5] s"),
        "most": (1, 10_000, "a number in [1, 10000]"),
    }
)
"""Least and largest values of `Rejoin`."""


@dataclass(frozen=True)
class Rejoin:
    """Joining of tracks while tracking.

    Args:
        gap_s: longest gap, s.
        min_probability: least probability of a join; below it a track is a new object.
        decide_s: time from the first detection of a track to its decision, s.
        most: lost objects that are kept; then the oldest are dropped.
        embedding_model: model whose vectors are compared; None: none are.
        exits: polygons of the world frame, m, as doors: objects lost inside are gone, and others are new.
        passages: ways on which objects are not detected.

    Raises:
        ParameterError: a value is out of its bounds.
    """

    gap_s: float = 60.0
    min_probability: float = 0.95
    decide_s: float = 0.3
    most: int = 1000
    embedding_model: str | None = None
    exits: tuple[Polygon, ...] = ()
    passages: tuple[Passage, ...] = ()

    def __post_init__(self) -> None:
        for name, (least, most, expected) in _BOUNDS.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise ParameterError(f"rejoin.{name}", expected, f"{value:g}")
        if self.embedding_model is not None and not 1 <= len(self.embedding_model) <= LONGEST_MODEL:
            expected = f"1 to {LONGEST_MODEL} characters"
            raise ParameterError("rejoin.embedding_model", expected, str(len(self.embedding_model)))
        if (count := len(self.exits) + len(self.passages)) > MOST_SHAPES:
            raise ParameterError("rejoin.exits", f"at most {MOST_SHAPES} exits and passages", str(count))
        for k, one in enumerate(self.exits):
            check_polygon(f"rejoin.exits[{k}]", one, MOST_CORNERS)
        for k, way in enumerate(self.passages):
            path = f"rejoin.passages[{k}]"
            check_polygon(f"{path}.from", way.start, MOST_CORNERS)
            check_polygon(f"{path}.to", way.end, MOST_CORNERS)
            low, high = way.s
            if not 0.0 <= low < high <= self.gap_s:
                expected = f"two ascending times in [0, {self.gap_s:g}] s, the second within gap_s"
                raise ParameterError(f"{path}.s", expected, str(way.s))


class Kinds(NamedTuple):
    """Constants of the classes for joining, and the declared places."""

    motion: Array  # (C, 8) fields of `Motion`
    kind: Index  # (C,) first class of its group
    area: Array  # (C,) m^2
    declared: DeclaredPlaces

    @classmethod
    def of(cls, parameters: Parameters, settings: Rejoin | None = None) -> Kinds:
        """Return the constants of the classes of a profile, and the places that the settings declare."""
        groups = [one.group or name for name, one in parameters.classes.items()]
        motion = np.array([motion_of(name) for name in parameters.labels])
        kind = np.array([groups.index(one) for one in groups], dtype=np.int64)
        area = np.array([one.area for one in parameters.classes.values()])
        shapes = () if settings is None else (settings.exits, settings.passages)
        return cls(motion, kind, area, DeclaredPlaces.of(*shapes))


@kernel
def _newest(stamp_ns: Index, most: int) -> Index:
    """Return the rows of the newest stamps, at most so many, ascending."""
    if stamp_ns.shape[0] <= most:
        return np.arange(stamp_ns.shape[0])
    return np.sort(np.argsort(-stamp_ns, kind="mergesort")[:most])


@kernel
def _candidates(live: Tracklets, lost: Tracklets, stamp_ns: int, young: int) -> Index:
    """Return the ends that are compared: rows of the lost objects and, behind these, of live ones not detected now."""
    coasting = np.flatnonzero((live.object >= 0) & (live.last_ns < stamp_ns))
    ends = np.concatenate((np.arange(lost.id.shape[0]), lost.id.shape[0] + coasting))
    last_ns = np.concatenate((lost.last_ns, live.last_ns[coasting]))
    return ends[_newest(last_ns, MOST_SCORES // max(young, 1))]


@kernel
def _scores(
    tables: tuple[Tracklets, Tracklets, Beginnings, Returns, Ends, Statistics],
    ends: Index,
    young: Index,
    due: Flags,
    moment: tuple[int, float],
    kinds: Columns,
    looks: tuple[Vectors, KnownTexts],
) -> tuple[Array, Array]:
    """Return s_ij (E, M) of ends and beginnings, NaN or -inf where they are not joined, and its part by appearance.

    Only pairs connected with a decision by pairs that may be joined are scored.

    Args:
        tables: lost objects, live tracks, beginnings, returns, ends and statistics of classes.
        ends: (E,) rows of the lost objects and, behind these, of live tracks.
        young: (M,) rows of live tracks that began lately.
        due: (M,) those on which to decide.
        moment: stamp and `Rejoin.gap_s`.
        kinds: the fields of `Kinds`.
        looks: vectors and attributes of the tracks and of the lost objects.
    """
    (lost, live, begun, returns, gone, known), (motion, kind, area, plan), (stamp_ns, gap_s) = tables, kinds, moment
    declared, many = DeclaredPlaces(*plan), lost.id.shape[0]
    score, appeared = np.full((ends.shape[0], young.shape[0]), math.nan), np.zeros((ends.shape[0], young.shape[0]))
    vectors, texts = looks
    again = np.full(ends.shape[0], math.nan)
    wanted, used, grows = due.copy(), np.zeros(ends.shape[0], np.bool_), True
    news = np.zeros(area.shape[0])
    for n in range(begun.id.shape[0]):
        news[begun.kind[n]] += begun.new[n]
    while grows:
        grows = False
        for m in range(young.shape[0]):
            k = young[m]
            c = kind[live.label[k]]
            seconds = max(min(RECENT_NS, stamp_ns - known.since_ns[c]) * _NS, 1.0)
            # The own beginning of a track that was decided on is among the others, with at most one.
            everywhere = max(1.0 + news[c] - (live.object[k] >= 0), 1e-12) / area[live.label[k]]
            least_log, log_rate = math.log(0.5 * everywhere / seconds), math.nan
            if in_exit(declared, live.begin[k]):
                least_log = math.inf
            for at in range(ends.shape[0]):
                if not math.isnan(score[at, m]) or not (wanted[m] or used[at]):
                    continue
                table, n = (lost, ends[at]) if ends[at] < many else (live, ends[at] - many)
                value = pair_score(table, n, live, k, kind, motion, gap_s)
                if value > -math.inf:
                    way, share = passage_score(table, n, live, k, declared), 0.0
                    if way == -math.inf:
                        way, share = learned_score(table, n, live, k, c, returns)
                        if math.isnan(again[at]):
                            again[at] = return_score(gone, c, table.end[n])
                        value += again[at]
                    value = log_sum(value + math.log1p(-share), way)
                    sizes = known.count[c], known.mean[c], known.square[c]
                    value += size_score(table.size[n], live.size[k], sizes[0], sizes[1], sizes[2], LEAST_SIZES)
                    if texts.id.shape[0] > 0:
                        value += attribute_score(texts, table.id[n], live.id[k])
                    if vectors.total.shape[1] > 0:
                        appeared[at, m] = appearance_score(vectors, table.id[n], live.id[k], c)
                if value + max(appeared[at, m], 0.0) > least_log and not in_exit(declared, table.end[n]):
                    if math.isnan(log_rate):
                        around = beginnings_around(begun, c, live.id[k], live.begin[k, 0], live.begin[k, 1])
                        around += BY_END * ends_around(lost, ends[ends < many], live, k, kind)
                        around += BY_END * ends_around(live, ends[ends >= many] - many, live, k, kind)
                        log_rate = math.log(0.5 * (everywhere + around) / seconds)
                    value = round((value + appeared[at, m] - log_rate) / QUANTUM) * QUANTUM
                else:
                    value = -math.inf
                score[at, m] = value
                if value > 0.0:
                    grows |= not (wanted[m] and used[at])
                    wanted[m] = used[at] = True
    return score, appeared


@kernel
def _count_gaps(
    score: Array,
    tables: tuple[Tracklets, Tracklets],
    ends: Index,
    young: Index,
    due: Flags,
    kind: Index,
    vectors: Vectors,
) -> None:
    """Count the distances of pairs that are sure by their scores without appearance."""
    lost, live = tables
    many = lost.id.shape[0]
    for m in np.flatnonzero(due):
        best = -1
        for at in range(ends.shape[0]):
            if score[at, m] >= SURE and (best < 0 or score[at, m] > score[best, m]):
                best = at
        if best < 0:
            continue
        rest = 0.0
        for at in range(ends.shape[0]):
            if at != best and score[at, m] > rest:
                rest = score[at, m]
        for other in range(young.shape[0]):
            if other != m and score[best, other] > rest:
                rest = score[best, other]
        if score[best, m] - rest >= SURE:
            k = young[m]
            one = lost.id[ends[best]] if ends[best] < many else live.id[ends[best] - many]
            count_distance(vectors, one, live.id[k], kind[live.label[k]])


@kernel
def _positive(score: Array) -> tuple[Index, Index, Array]:
    """Return rows, columns and scores of the pairs that may be joined, at most `MOST_PAIRS`, the lowest left out."""
    before, after = np.nonzero(score > 0.0)
    gain = np.empty(before.shape[0])
    for p in range(before.shape[0]):
        gain[p] = score[before[p], after[p]]
    if before.shape[0] > MOST_PAIRS:
        best = np.sort(np.argsort(-gain, kind="mergesort")[:MOST_PAIRS])
        before, after, gain = before[best], after[best], gain[best]
    return before, after, gain


@kernel
def _name_candidate(live: Tracklets, k: int, table: Tracklets, row: int, odds: float) -> None:
    """Write the earlier object that fits live row `k` best, and the probability that it continues one by its odds."""
    live.candidate[k], live.candidate_probability[k] = table.object[row], 1.0 / (1.0 + math.exp(-odds))


@kernel
def _continue(live: Tracklets, k: int, table: Tracklets, row: int, probability: float) -> None:
    """Let live row `k` go on with the object of a row before the gap."""
    live.object[k], live.probability[k] = table.object[row], table.probability[row] * probability
    share = table.detections[row] / (table.detections[row] + live.detections[k])
    for s in range(3):
        size, own = table.size[row, s], live.size[k, s]
        live.size[k, s] = own if math.isnan(size) else size if math.isnan(own) else own + share * (size - own)
    live.detections[k] += table.detections[row]


@kernel
def decide(
    given: tuple[Array, Array, Array, Array, Array, Array],
    young: Index,
    due: Flags,
    stamp_ns: int,
    kinds: Columns,
    limits: tuple[float, float],
    looks: tuple[Vectors, KnownTexts],
) -> tuple[Array, Array, Array, Array, Index]:
    """Decide on new tracks: write their objects to the words of the live tracks, and sizes to the words of the classes.

    Args:
        given: words of the live tracks, the lost objects, the beginnings, the returns, the ends and the classes.
        young: (M,) rows of live tracks that began lately.
        due: (M,) those on which to decide.
        stamp_ns: of the frame.
        kinds: the fields of `Kinds`.
        limits: `Rejoin.gap_s` and `min_probability`.
        looks: vectors and attributes of the tracks and of the lost objects.

    Returns:
        The words of the lost objects, the beginnings, the returns and the ends, and the rows of live tracks that were
        joined: they are not detected any more, and end.
    """
    live_words, lost_words, begun_words, return_words, end_words, class_words = given
    live, lost, known = tracklets_in(live_words), tracklets_in(lost_words), statistics_in(class_words)
    kind, many = kinds[1], lost.id.shape[0]
    ends = _candidates(live, lost, stamp_ns, young.shape[0])
    tables = lost, live, beginnings_in(begun_words), returns_in(return_words), ends_in(end_words), known
    score, appeared = _scores(tables, ends, young, due, (stamp_ns, limits[0]), kinds, looks)
    if looks[0].total.shape[1] > 0:
        _count_gaps(score - appeared, (lost, live), ends, young, due, kind, looks[0])
    decided = np.flatnonzero(due)
    return_words = with_returns(return_words, (lost, live), ends, young[decided], score[:, decided], stamp_ns, kind)
    before, after, gain = _positive(score)
    taken, margin, odds = match(before, after, gain, due, ends.shape[0])
    kept, gone = np.ones(many, np.bool_), np.zeros(live.id.shape[0], np.bool_)
    returned = np.zeros(many), np.zeros(live.id.shape[0])
    for m in decided:
        k, best = young[m], -1
        count_sizes(known, kind[live.label[k]], live.size[k])
        live.object[k] = live.id[k]
        for at in range(ends.shape[0]):
            if score[at, m] > (-math.inf if best < 0 else score[best, m]):
                best = at
        if best >= 0:
            table, row = (lost, ends[best]) if ends[best] < many else (live, ends[best] - many)
            _name_candidate(live, k, table, row, odds[m] if odds[m] > -math.inf else score[best, m])
    for n in np.flatnonzero(taken & due[after]):
        probability, k, row = 1.0 / (1.0 + math.exp(-margin[n])), young[after[n]], ends[before[n]]
        table, at = (lost, row) if row < many else (live, row - many)
        _name_candidate(live, k, table, at, margin[n])
        if probability >= limits[1]:
            if row < many:
                kept[row], returned[0][at] = False, probability
                _continue(live, k, lost, row, probability)
            else:
                gone[at], returned[1][at] = True, probability
                _continue(live, k, live, row - many, probability)
    end_words = with_ends(end_words, lost, np.flatnonzero(~kept), returned[0], stamp_ns, kind)
    end_words = with_ends(end_words, live, np.flatnonzero(gone), returned[1], stamp_ns, kind)
    if not kept.all():
        lost_words = selected(lost_words, np.flatnonzero(kept), TRACKLETS)
    begun_words = with_beginnings(begun_words, live, young[decided], odds[decided], stamp_ns, kinds, known)
    return lost_words, begun_words, return_words, end_words, np.flatnonzero(gone)


@kernel
def _rivals(live: Tracklets, stamp_ns: int, decide_s: float) -> tuple[Index, Flags]:
    """Return the rows of live tracks that compete for lost objects, and those on which to decide."""
    young, due, count = np.empty(live.id.shape[0], np.int64), np.empty(live.id.shape[0], np.bool_), 0
    for k in range(live.id.shape[0]):
        undecided = live.object[k] < 0
        late = live.object[k] == live.id[k] and live.first_ns[k] >= stamp_ns - RIVAL_NS
        if live.confirmed[k] and (undecided or late):
            ready = live.last_ns[k] == stamp_ns and live.detections[k] > 1
            young[count], count = k, count + 1
            due[count - 1] = undecided and ready and (stamp_ns - live.first_ns[k]) * _NS >= decide_s
    return young[:count], due[:count]


@kernel
def _within_limits(lost_words: Array, stamp_ns: int, gap_s: float, most: int) -> tuple[Array, int]:
    """Return the words of the lost objects of the last `gap_s`, at most so many, and how many are too many."""
    lost = tracklets_in(lost_words)
    rows = np.flatnonzero((stamp_ns - lost.last_ns) * _NS <= gap_s)
    if rows.shape[0] == lost.id.shape[0] and rows.shape[0] <= most:
        return lost_words, 0
    kept = rows[_newest(lost.last_ns[rows], most)]
    return selected(lost_words, kept, TRACKLETS), max(0, rows.shape[0] - most)


@kernel
def _objects_of(identity: Index, live: Tracklets) -> tuple[Index, Array, Index, Array]:
    """Return object, candidate and their probabilities of tracks (ascending ids); -1 where a track is not live."""
    objects, probability, k = np.full(identity.shape[0], -1), np.ones(identity.shape[0]), 0
    candidate, chance = np.full(identity.shape[0], -1), np.full(identity.shape[0], math.nan)
    for n in range(identity.shape[0]):
        while k < live.id.shape[0] and live.id[k] < identity[n]:
            k += 1
        if k < live.id.shape[0] and live.id[k] == identity[n]:
            objects[n], probability[n] = live.object[k], live.probability[k]
            candidate[n], chance[n] = live.candidate[k], live.candidate_probability[k]
    return objects, probability, candidate, chance


@kernel
def advance(
    given: tuple[Array, Array, Array],
    moment: tuple[Array, Array, int],
    motion: Array,
    limits: tuple[float, float, float, int],
) -> tuple[Array, Array, Array, Index, Array, Index, Array, bool]:
    """Return the words of the live tracks, their places and the lost objects after a frame, before any decision.

    Args:
        given: those before it.
        moment: words of the tracks of the frame and of the objects of the density, and the stamp.
        motion: `Kinds.motion`.
        limits: the first fields of `Rejoin`.

    Returns:
        The words; object and probability, candidate and its probability (N,) of the tracks of the frame; and whether a
        track is decided or a lost object is dropped, which `settle` does.
    """
    track_words, object_words, stamp_ns = moment
    live_words, place_words, lost_words = follow(given, track_words, object_words, stamp_ns, motion)
    live, lost = tracklets_in(live_words), tracklets_in(lost_words)
    changes = lost.id.shape[0] > limits[3]
    for is_due in _rivals(live, stamp_ns, limits[2])[1]:
        changes = changes or is_due
    for last_ns in lost.last_ns:
        changes = changes or (stamp_ns - last_ns) * _NS > limits[0]
    return live_words, place_words, lost_words, *_objects_of(tracks_in(track_words).id, live), changes


@kernel
def settle(
    given: Columns,
    moment: tuple[Array, int],
    kinds: Columns,
    limits: tuple[float, float, float, int],
    looks: tuple[Columns, Columns],
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Index, Array, Index, Array, Index, int, int]:
    """Decide on the tracks of a frame and drop lost objects; return the words of `Rejoining`.

    Args:
        given: those before.
        moment: words of the tracks of the frame, and the stamp.
        kinds: the fields of `Kinds`.
        limits: the first fields of `Rejoin`.
        looks: the fields of `Vectors` and of `KnownTexts`.

    Returns:
        The words; object and probability, candidate and its probability (N,) of the tracks of the frame; ids of the
        objects that were joined while they were not detected; and the numbers of joins and of lost objects that were
        dropped because there were too many.
    """
    live_words, place_words, lost_words, begun_words, return_words, end_words, class_words = given
    gap_s, least, decide_s, most = limits
    track_words, stamp_ns = moment
    live = tracklets_in(live_words)
    young, due = _rivals(live, stamp_ns, decide_s)
    joined, ends = 0, np.empty(0, np.int64)
    if due.any():
        class_words = class_words.copy()
        had = live.object.copy()
        lost_words, begun_words, return_words, end_words, rows = decide(
            (live_words, lost_words, begun_words, return_words, end_words, class_words),
            young,
            due,
            stamp_ns,
            kinds,
            (gap_s, least),
            (Vectors(*looks[0]), KnownTexts(*looks[1])),
        )
        joined = np.sum((had < 0) & (live.object >= 0) & (live.object != live.id))
        if rows.shape[0]:
            ends, stays = live.id[rows], np.ones(live.id.shape[0], np.bool_)
            stays[rows] = False
            others = np.flatnonzero(stays)
            live_words = selected(live_words, others, TRACKLETS)
            place_words = selected(place_words, others, PLACE_COLUMNS)
            live = tracklets_in(live_words)
    lost = tracklets_in(lost_words)
    late = np.flatnonzero((stamp_ns - lost.last_ns) * _NS > gap_s)
    if gap_s > 0.0:  # while nothing is joined, nothing returns
        end_words = with_ends(end_words, lost, late, np.zeros(lost.id.shape[0]), stamp_ns, kinds[1])
    lost_words, dropped = _within_limits(lost_words, stamp_ns, gap_s, most)
    words = live_words, place_words, lost_words, begun_words, return_words, end_words, class_words
    return *words, *_objects_of(tracks_in(track_words).id, live), ends, joined, dropped


class Joined(NamedTuple):
    """Tracks of a frame with their objects.

    Attributes:
        density: the posterior; objects that were joined while they were not detected are no longer in it.
        tracks: of the frame, without these objects.
        object: (N,) int64 id of the first track of the object, -1 while that is not decided.
        probability: (N,) that all joins of the object are right, 1 without a join.
        candidate: (N,) int64 earlier object that fitted best when the track was decided, -1: none did.
        candidate_probability: (N,) that the track continues an earlier object; NaN where none fitted.
        joins: of the frame.
        dropped: lost objects that were dropped because there were too many.
    """

    density: Density
    tracks: Tracks
    object: Index
    probability: Array
    candidate: Index
    candidate_probability: Array
    joins: int
    dropped: int


def rejoin_tracks(
    before: Rejoining | None,
    density: Density,
    tracks: Tracks,
    settings: Rejoin,
    kinds: Kinds,
    embedding: Embedding | None,
    detections: tuple[Index, Index],
) -> Joined:
    """Return the tracks of a frame with their objects.

    Args:
        before: the state before the frame; None before the first.
        density: the posterior. While the sensor is found to move without poses nothing is joined: places do not stay.
        tracks: of the frame.
        settings: the limits.
        kinds: of the classes.
        embedding: vectors of the detections.
        detections: row of each measurement among them, and (K,) the measurement of each object of the density.

    Raises:
        FrameError: vectors of another length than before.
    """
    state = before or Rejoining.empty(len(kinds.kind), density.stamp_ns)
    gap_s = settings.gap_s if density.sensor_motion is None else 0.0
    # As these types: for others the kernels would be compiled once more.
    limits = float(gap_s), settings.min_probability, float(settings.decide_s), int(settings.most)
    looks, vectors, (chosen, measurement) = None, NOTHING, detections
    if (model := settings.embedding_model) is not None and (embedding is not None or state.appearance is not None):
        rows = tracks.detection >= 0
        identity = tracks.id[rows]
        source = chosen[measurement[np.searchsorted(density.bernoulli.id, identity)]]
        looks = seen(state, model, embedding, (identity, tracks.label[rows], source), kinds.kind, density.stamp_ns)
    live, places, lost, objects, probability, candidate, chance, changes = advance(
        (state.live.words, state.places.words, state.lost.words),
        (tracks.words, density.bernoulli.words, density.stamp_ns),
        kinds.motion,
        limits,
    )
    rest: tuple[Any, ...] = state.beginnings, state.returns, state.ends, state.classes
    ended, joins, dropped = _NONE, 0, 0
    if changes:
        if looks is not None:
            appearance, ids = looks
            vectors = Vectors(ids, appearance.total, state.lost.id, appearance.lost, appearance.counts)
        words = settle(
            (live, places, lost, *(one.words for one in rest)),
            (tracks.words, density.stamp_ns),
            (*kinds[:3], tuple(kinds.declared)),
            limits,
            (tuple(vectors), tuple(KnownTexts.of(density.attributes))),
        )
        live, places, lost, begun, returns, ends, known = words[:7]
        objects, probability, candidate, chance, ended, joins, dropped = words[7:]
        rest = Beginnings.of(begun), Returns.of(returns), Ends.of(ends), Statistics.of(known)
    after = Rejoining(Tracklets.of(live), Places.of(places), Lost.of(lost), *rest)
    if looks is not None:
        after = replace(after, appearance=aligned(*looks, state.lost, after.live, after.lost))
    texts = None if density.attributes is None else _of_objects(density.attributes, state, after.live)
    density = replace(density, rejoining=after, attributes=texts)
    if len(ended):
        stays = ~np.isin(tracks.id, ended)
        density, tracks = _without(density, ended), tracks.take(stays)
        objects, probability, candidate, chance = objects[stays], probability[stays], candidate[stays], chance[stays]
    return Joined(density, tracks, objects, probability, candidate, chance, joins, dropped)


def _of_objects(attributes: Attributes, before: Rejoining, live: Tracklets) -> Attributes:
    """Move the attributes of lost objects to the tracks that continue them now."""
    last = {
        number: row
        for rows in (before.lost, before.live)
        for number, row in zip(rows.object.tolist(), rows.id.tolist(), strict=True)
    }
    joined = (live.object >= 0) & (live.object != live.id)
    own = {
        last[number]: row
        for number, row in zip(live.object[joined].tolist(), live.id[joined].tolist(), strict=True)
        if number in last
    }
    identity = np.array([own.get(one, one) for one in attributes.id.tolist()], np.int64)
    if np.array_equal(identity, attributes.id):
        return attributes
    return gathered(Attributes.empty(), identity, attributes.name, attributes.text, attributes.evidence)


def _without(density: Density, identity: Index) -> Density:
    stays = ~np.isin(density.bernoulli.id, identity)
    own, pi, misses = density.self_calibration, density.class_probability, density.misses
    if own is not None:
        own = replace(own, objects=own.objects[stays], innovations=own.innovations[stays])
    return replace(
        density,
        bernoulli=density.bernoulli.take(stays),
        misses=None if misses is None else misses.take(stays),
        class_probability=None if pi is None else pi[stays],
        self_calibration=own,
    )

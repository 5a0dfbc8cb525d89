"""`optipmb track`: a data set, or a dump that a service saved, through the tracker in this process."""

import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from optipmb_client.errors import TrackingFailed, UsageError

from optipmb_tools.commands.options import (
    AsJson,
    Classes,
    Data,
    DataOptions,
    Digits,
    Full,
    JobOptions,
    Origin,
    Out,
    Profile,
    number_or_text,
    print_json,
    report,
    say,
    warn,
)
from optipmb_tools.files import remove_unfinished
from optipmb_tools.results.exports import check_export, is_features, is_openlabel
from optipmb_tools.table_files import is_table
from optipmb_tools.views.progress import FrameProgress

if TYPE_CHECKING:
    from optipmb_tools.run.rejoining import RejoinOptions
    from optipmb_tools.run.tracking import TrackedSequence


_SHOWN = 20  # recordings that are named
_MANY = 50  # detections of which some should make tracks
_HARDLY = 0.05  # share of the rows of tracks that are confirmed, below which numbers may have another meaning
_SHORT = 3.0  # rows of a track up to which nothing was followed


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """Options of offline tracking."""

    out: Out = Path("out/track")
    profile: Profile = None
    classes: Classes = None
    full: Full = False
    digits: Digits = "unit"
    origin: Origin = None
    smooth: Annotated[
        bool,
        typer.Option("--smooth", help="Estimate every state from all frames of its track, later ones too: for labels."),
    ] = False
    hindsight: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=10.0,
            help="Show tracks as a whole or not, with velocities by so many seconds after a frame; 0: as the service.",
        ),
    ] = 1.0
    show: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="Least probability of tracks that are shown (confirmed); default: that of the profile, 0.5 at most.",
            show_default=False,
        ),
    ] = None
    fuse: Annotated[
        bool,
        typer.Option("--fuse", help="The sensors of a recording feed one density, by turns: by the column sensor."),
    ] = False
    sensors: Annotated[
        Path | None,
        typer.Option(
            "--sensors", help="With --fuse: settings of a service (TOML), whose [sensors] say how sensors differ."
        ),
    ] = None
    rejoin: Annotated[
        float | None,
        typer.Option(
            metavar="[GAP_S]",
            help="Join the tracks of an object that is seen again after at most so many seconds (60): the columns "
            "object and object_probability of a table.",
            show_default=False,
        ),
    ] = None
    min_probability: Annotated[
        float | None, typer.Option(help="With --rejoin: least probability of a join; default 0.9.", show_default=False)
    ] = None
    places: Annotated[
        Path | None,
        typer.Option(help="With --rejoin: settings (TOML) whose [rejoin.PATTERN] has exits and passages."),
    ] = None
    ids: Annotated[
        str,
        typer.Option(metavar="track|object", help="With --rejoin, object: ids of objects, in any format."),
    ] = "track"
    keep_input: Annotated[
        bool, typer.Option("--keep-input", help="Of a bag, with --out FILE.mcap: also copy what is in it.")
    ] = False
    view: Annotated[
        Path | None,
        typer.Option("--view", help="Also write the confirmed tracks of one recording as a page for a browser: .html."),
    ] = None
    submission: Annotated[
        str | None,
        typer.Option(metavar="[SCORE]", help="Write a submission; of KITTI confirmed tracks from this mean score on."),
    ] = None

    def rejoining(self) -> "RejoinOptions | None":
        """Return which tracks are joined.

        Raises:
            UsageError: A value is out of its bounds.
        """
        if self.rejoin is None:
            return None
        from optipmb_tools.run.rejoining import RejoinOptions, places_in  # noqa: PLC0415  only with this option

        least = RejoinOptions.min_probability if self.min_probability is None else self.min_probability
        return RejoinOptions(self.rejoin, least, *() if self.places is None else places_in(self.places))

    def _check_joining(self) -> None:
        out = self.out
        if self.ids not in {"track", "object"} or (self.ids == "object" and self.rejoin is None):
            raise UsageError(f"--ids {self.ids}: expected track, or object with --rejoin")
        if self.rejoin is not None and self.ids == "track" and (not is_table(out) or out.is_dir()):
            raise UsageError(f"--rejoin: expected --ids object or a table as --out, such as tracks.csv, received {out}")
        if self.rejoin is None and self.min_probability is not None:
            raise UsageError(f"--min-probability {self.min_probability:g}: expected --rejoin")
        if self.rejoin is None and self.places is not None:
            raise UsageError(f"--places {self.places}: expected --rejoin")

    def check_out(self, data: Data) -> None:
        """Refuse a file where the results are several; a bag of tracks holds one topic of a bag."""
        out = self.out
        check_export(out, data.dataset, len(data.sequences))
        if self.full and is_features(out):
            raise UsageError(f"--full: expected a folder, a table or OpenLABEL as --out, received {out}")
        self._check_joining()
        if self.sensors is not None and not self.fuse:
            raise UsageError(f"--sensors {self.sensors}: expected --fuse, for one sensor has --profile alone")
        if self.view is not None and (self.view.suffix != ".html" or len(data.sequences) > 1):
            count = len(data.sequences)
            raise UsageError(f"--view {self.view}: expected a file .html of one recording, received {count} recordings")
        if self.submission is not None and (self.full or is_table(out) or is_features(out) or is_openlabel(out)):
            raise UsageError("--submission: expected a folder as --out, and no --full: the files are for the benchmark")
        if out.suffix != ".mcap":
            return
        if data.name != "rosbag":
            raise UsageError(f"--out {out}: expected a folder, or a table: only tracks of a bag are written as a bag")
        if len(data.sequences) > 1:
            names = " ".join(data.names)
            raise UsageError(f"--out {out}: expected one of the bag's topics by --sequences, received {names}")


def track(
    data: DataOptions,
    *,
    how: TrackOptions,
    jobs: JobOptions,
    dump: Annotated[
        Path | None, typer.Option("--dump", help="What a service saved of a stream when tracking it failed.")
    ] = None,
    trace: Annotated[bool, typer.Option("--trace", help="With --dump: also print where the error was raised.")] = False,
    as_json: AsJson = False,
) -> None:
    """Track your data on this machine, without a service.

    From a bag of ROS 2, --out FILE.mcap makes a bag with the tracks as TrackedObjects, Detection3DArray and markers.

    A profile may also be a TOML file here. Tracks are shown (confirmed) as a whole, by all of their frames, or not at
    all; with --hindsight 0, replaying the same data through a service gives the same files.
    With --rejoin, a table also says which tracks are of the same object; ids stay (docs/gaps.md).
    With --smooth, positions, headings and velocities also use later frames, which no service can.

    With --dump, the frames that a service saved are tracked again instead. Status 1 and one line say which
    of them raises which error; status 0 that none does any more.
    """
    if dump is not None:
        _replay_dump(dump, trace=trace, as_json=as_json)
        return
    from optipmb_tools.run import profiles, tracking  # noqa: PLC0415  loads the tracker and its compiler

    opened = _opened(data, how)
    rejoin = how.rejoining()
    chosen = opened.sequences
    name = how.profile or opened.dataset.profile
    parameters = profiles.profile_for(name, chosen)
    notes = [f"profile auto: {parameters.provenance}"] if name == profiles.AUTO and data.verbose else []
    for note in (*profiles.doubts(parameters, chosen), *notes):
        warn(note)
    sensors = profiles.read_sensors(how.sensors)
    results = []
    failed = None
    try:
        with (
            FrameProgress("tracking", opened.frames) as progress,
            jobs.executor(opened.frames, len(chosen)) as executor,
        ):
            for result in tracking.track(
                opened.dataset,
                chosen,
                how.out,
                tracking.Tracking(
                    *(parameters, how.classes or ()),
                    full=how.full,
                    smooth=how.smooth,
                    hindsight_s=how.hindsight,
                    show=how.show,
                    sensors=sensors,
                    rejoin=rejoin,
                    ids=how.ids,
                    view=how.view,
                ),
                executor=executor,
                on_frame=progress.advance,
                note=lambda text: progress.note(f"optipmb: {text}"),
            ):
                results.append(result)
                if not as_json:
                    _say_result(result)
    except tracking.RecordingsFailed as error:
        failed = error
    except KeyboardInterrupt:
        remove_unfinished(how.out, opened.names)
        done = 0 if is_table(how.out) or is_features(how.out) else len(results)
        raise typer.Abort(f"{done} of {len(chosen)} recordings are in {how.out}") from None
    reasons = {} if failed is None else {name: one.reason for name, one in failed.failures.items()}
    shown = {"command": "track", "dataset": opened.name, "profile": name, "out": how.out, "sequences": results}
    rows, unconfirmed = (sum(getattr(one, name) for one in results) for name in ("rows", "unconfirmed_rows"))
    text = f"results in {how.out}" + (f" ({unconfirmed} of {rows} rows are not confirmed)" if unconfirmed else "")
    report({**shown, "failed": reasons}, text, *([f"page in {how.view}"] if how.view else []), as_json=as_json)
    if failed is not None:
        raise failed
    _complain(results, parameters.name)


def _opened(data: DataOptions, how: TrackOptions) -> Data:
    more: dict[str, float | str] = {name: 1 for name in ("keep_input", "fuse") if getattr(how, name)}
    more["digits"] = how.digits
    if how.origin is not None:
        more["origin"] = how.origin
    if how.submission is not None:
        more["submission"] = number_or_text(how.submission)
    opened = data.open(**more)
    how.check_out(opened)
    return opened


def _say_result(result: "TrackedSequence") -> None:
    rate = result.frames / max(result.seconds, 1e-9)
    step = f", step p50 {result.step.p50_ms:.2f} ms p99 {result.step.p99_ms:.2f} ms" if result.step else ""
    say(f"{result.name}: {result.frames} frames, {result.tracks} tracks, {rate:.0f} frames/s{step}")
    if result.joined is not None:
        say(f"{result.name}: {result.joined[0]} confirmed tracks are {result.joined[1]} objects")
    if result.learned:
        say(f"{result.name}: learned {'; '.join(result.learned)}")


def _complain(results: "list[TrackedSequence]", profile: str) -> None:
    """Print the detections that were left out; end with status 1 without tracks."""
    detections = sum(one.detections for one in results)
    if empty := [one.name for one in results if not one.detections]:
        frames = sum(one.frames for one in results if not one.detections)
        shown = " ".join([*empty[:_SHOWN], *(["…"] if len(empty) > _SHOWN else [])])
        warn(f"no detections in {len(empty)} of {len(results)} recordings, {frames} frames: {shown}")
    left_out: Counter[str] = sum((Counter(one.left_out) for one in results), Counter())
    if left_out:
        named = ", ".join(f"{count} {name}" for name, count in sorted(left_out.items()))
        warn(f"{left_out.total()} of {detections} detections are left out with profile {profile}: {named}")
    if estimated := sum(one.estimated for one in results):
        frames = sum(one.frames for one in results)
        warn(f"the motion of the sensor is estimated in {estimated} of {frames} frames: boxes have no poses")
    for doubt in [f"{one.name}: {doubt}" for one in results for doubt in one.doubts]:
        warn(doubt)
    cut, samples = map(sum, zip(*(one.cut for one in results), strict=True))
    if cut:
        from optipmb_tools.results.nuscenes import NUSCENES_MAX_BOXES  # noqa: PLC0415  of one format

        warn(f"{cut} boxes in {samples} samples are not written: a sample of nuScenes has {NUSCENES_MAX_BOXES} at most")
    rows = sum(one.rows for one in results)
    confirmed = rows - sum(one.unconfirmed_rows for one in results)
    if not rows:
        if detections:
            warn(f"no tracks came of {detections} detections: do their scores and rate fit profile {profile}?")
        raise typer.Exit(1)
    tracks = sum(one.tracks for one in results)
    if tracks >= _MANY and confirmed < _SHORT * tracks:
        warn(
            f"hardly any track outlives a frame, {tracks} tracks have {confirmed} rows: are the rate, the units of "
            "time and length, and the grouping of frames right?"
        )
    if detections >= _MANY and confirmed < _HARDLY * rows:
        warn(
            f"hardly anything is tracked, {confirmed} of {rows} rows are confirmed: are places and times in the units "
            "that `optipmb check` shows, and higher scores the surer ones?"
        )


def _replay_dump(file: Path, *, trace: bool, as_json: bool) -> None:
    from optipmb_tools.run import dumps  # noqa: PLC0415  loads the tracker and its compiler

    result = dumps.replay(dumps.read(file))
    if as_json:
        print_json({"command": "track", "dump": file, "result": result})
    if result.error is None:
        say(f"{result.stream}: {result.frames} frames without an error; saved was {result.saved}")
        return
    if trace:
        print(result.trace, file=sys.stderr)  # noqa: T201  it was asked for
    again = "the saved error again" if result.same else f"another error than the saved one ({result.saved})"
    raise TrackingFailed(f"{result.stream}: frame {result.seq}, stamp {result.stamp_ns} ns: {result.error}: {again}")

"""What runs of a load came to, as a table, and as a picture of latency against throughput."""

from collections.abc import Sequence
from pathlib import Path

from optipmb_schemas.installation import install_command
from rich.table import Table

from optipmb_client.colours import COLOURS
from optipmb_client.errors import ClientError
from optipmb_client.load.run import STAGES, Run

_STYLES = ("-", "--", "-.", ":")
_MARKS = ("o", "s", "^", "D")


def table_of(runs: Sequence[Run], latency_ms: float | None = None) -> Table:
    """Return the runs, a row each; with a latency, also whether it was held."""
    table = Table(box=None, pad_edge=False)
    columns = ["streams", "Hz each", "frames/s", "sent", "received", "lost", "p50 ms", "p99 ms", "max ms"]
    columns += [f"{stage} p50|p99" for stage in STAGES] + ["sent late p99", "generator"]
    for name in columns + ([f"{latency_ms:g} ms"] if latency_ms is not None else []):
        table.add_column(name, justify="right", no_wrap=True)
    for run in sorted(runs, key=lambda run: run.rate):
        row = [str(run.streams), f"{run.rate:.1f}", f"{run.throughput:.0f}", str(run.sent), str(run.received)]
        row += [str(run.lost), f"{run.p50_ms:.2f}", f"{run.p99_ms:.2f}", f"{run.max_ms:.1f}"]
        row += [f"{run.stages_p50_ms[stage]:.2f}|{run.stages_p99_ms[stage]:.2f}" for stage in STAGES]
        row += [f"{run.late_p99_ms:.2f} ms", f"{run.generator_cpu:.0%}"]
        table.add_row(*row, *([("held" if run.holds(latency_ms) else "not held")] if latency_ms is not None else []))
    return table


def draw_runs(path: Path, runs: Sequence[Run], latency_ms: float | None = None) -> None:
    """Draw median and 99th percentile, and the median of each stage, against the frames per second.

    Raises:
        ClientError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  matplotlib is an extra
        from matplotlib.figure import Figure  # noqa: PLC0415  matplotlib is an extra
    except ImportError as error:
        raise ClientError(f"pictures need matplotlib, which is not installed: {install_command('plot')}") from error
    runs = sorted(runs, key=lambda run: run.throughput)
    rates = [run.throughput for run in runs]
    figure = Figure(figsize=(8.0, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(rates, [run.p99_ms for run in runs], color="#222222", linestyle="--", marker="v", label="99th percentile")
    axes.plot(rates, [run.p50_ms for run in runs], color="#222222", marker="o", linewidth=2, label="median")
    for stage, colour, style, mark in zip(STAGES, COLOURS, _STYLES, _MARKS, strict=False):
        values = [run.stages_p50_ms[stage] for run in runs]
        axes.plot(rates, values, color=colour, linestyle=style, marker=mark, markersize=4, label=f"median of {stage}")
    if latency_ms is not None:
        axes.axhline(latency_ms, color="#D55E00", linewidth=0.8)
        axes.annotate(f"limit {latency_ms:g} ms", (rates[0], latency_ms), va="bottom", fontsize=8, color="#D55E00")
    first = runs[0]
    cloud = f", clouds of {first.points:.0f} points" if first.points else ", no clouds"
    axes.set_title(f"{first.streams} streams, {first.objects:.0f} objects{cloud}", fontsize=10)
    axes.set_xlabel("frames per second, all streams")
    axes.set_ylabel("milliseconds from put to tracks")
    axes.set_yscale("log")
    axes.grid(visible=True, which="both", linewidth=0.3)
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)

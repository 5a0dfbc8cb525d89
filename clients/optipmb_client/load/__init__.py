"""Load on a running service: how many frames it carries, and how long their tracks take.

material    the frames, encoded before the first is sent
run         sends them in time, and times what comes back
limit       looks for the highest rate that holds a latency
report      a table and a picture of what was measured
"""

from optipmb_client.load.limit import find_limit
from optipmb_client.load.material import Frames, generated, recorded
from optipmb_client.load.report import draw_runs, table_of
from optipmb_client.load.run import Load, Run, run_load

__all__ = ["Frames", "Load", "Run", "draw_runs", "find_limit", "generated", "recorded", "run_load", "table_of"]

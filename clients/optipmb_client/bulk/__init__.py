"""The same function for many tasks: in this process, in several processes, or on a Ray cluster.

There is one loop (`run`) over one list of tasks, and three executors. A task is idempotent: it may run again after its
process was killed, and gives the same bytes. What a task raises is a value (`Failed`), so one bad recording stops no
other, and every exception reaches the caller's process whatever it is made of.
"""

from optipmb_client.bulk.choice import executor_for
from optipmb_client.bulk.executors import ATTEMPTS, Executor, Here
from optipmb_client.bulk.loop import Outcome, in_order, run, values
from optipmb_client.bulk.task import Done, Failed, WorkerDiedError

__all__ = [
    "ATTEMPTS",
    "Done",
    "Executor",
    "Failed",
    "Here",
    "Outcome",
    "WorkerDiedError",
    "executor_for",
    "in_order",
    "run",
    "values",
]

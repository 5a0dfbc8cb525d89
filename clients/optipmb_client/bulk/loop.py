"""The loop over tasks: hands them out, collects what comes back, and repeats those whose process died."""

import concurrent.futures
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from optipmb_client.bulk.executors import Executor
from optipmb_client.bulk.task import Done, Failed, WorkerDiedError

T = TypeVar("T")


@dataclass(frozen=True)
class Outcome:
    """What came of a task; `place` is its index in the list."""

    place: int
    result: Done[Any] | Failed


def run(
    executor: Executor, tasks: Sequence[Any], name: Callable[[Any], str], note: Callable[[str], None] = lambda _: None
) -> Iterator[Outcome]:
    """Run tasks on a started executor; yield what came of each as it ends, in no order.

    No more are under way than the executor asks for, so little is done twice when it ends early, and little waits to be
    collected. A task whose process died runs again, `executor.attempts` times in all.

    Args:
        executor: after its `start`.
        tasks: each is sent to where it runs.
        name: how a task is called in what is said about it.
        note: hears a line when a process died, and the trace of an error that nobody expected.
    """
    waiting = deque((place, 1) for place in range(len(tasks)))
    under_way: dict[concurrent.futures.Future[Any], tuple[int, int]] = {}
    while waiting or under_way:
        while waiting and len(under_way) < executor.width:
            place, number = waiting.popleft()
            under_way[executor.submit(tasks[place])] = place, number
        for future in concurrent.futures.wait(under_way, return_when=concurrent.futures.FIRST_COMPLETED).done:
            place, number = under_way.pop(future)
            try:
                result = executor.take(future)
            except WorkerDiedError as died:
                if number < executor.attempts:
                    note(f"{name(tasks[place])}: {died}; starts again")
                    waiting.appendleft((place, number + 1))
                    continue
                result = Failed(f"{died}, {number} times" if number > 1 else str(died))
            if isinstance(result, Failed) and result.trace:
                note(result.trace.rstrip())
            yield Outcome(place, result)


def in_order(ended: Iterable[tuple[int, T]]) -> Iterator[T]:
    """Yield what tasks gave in the order of their places, each when those before it have ended too."""
    waiting: dict[int, T] = {}
    following = 0
    for place, one in ended:
        waiting[place] = one
        while following in waiting:
            yield waiting.pop(following)
            following += 1


def values(
    executor: Executor, tasks: Sequence[Any], name: Callable[[Any], str], note: Callable[[str], None] = lambda _: None
) -> list[Any]:
    """Run tasks, and return what they gave, in their order.

    Raises:
        UsageError, ClientError: a task failed; the text names it.
    """
    results = list(in_order((outcome.place, outcome.result) for outcome in run(executor, tasks, name, note)))
    for failed in results:
        if isinstance(failed, Failed):
            raise failed.error()
    return [result.value for result in results if isinstance(result, Done)]

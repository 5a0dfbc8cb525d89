"""What messages make of values, as texts and bytes that can be compared, with numpy and in a process without it."""

import array
import math
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

BLOCKED = "import sys; sys.modules['numpy'] = None; sys.path.insert(0, sys.argv[1])"
Case = tuple[str, str, Any]


def command(code: str) -> list[str]:
    """Give the command that runs code in a Python where numpy cannot be imported; `sys.argv[2:]` are arguments."""
    return [sys.executable, "-c", f"{BLOCKED}\n{code}", str(Path(__file__).parent)]


def outcomes_without(cases: Sequence[Case]) -> list[Any]:
    code = "from without_numpy import outcome\nimport pickle\ncases = pickle.load(sys.stdin.buffer)\n"
    code += "sys.stdout.buffer.write(pickle.dumps([outcome(*case) for case in cases]))"
    done = subprocess.run(command(code), input=pickle.dumps(cases), stdout=subprocess.PIPE, check=True, timeout=300)
    result: list[Any] = pickle.loads(done.stdout)  # noqa: S301  from the process above
    return result


def outcome(action: str, kind: str, given: Any) -> Any:
    """Give the result of one case: the message in both forms and its numbers as lists, or the text of the error.

    Args:
        action: `make` a message of the fields `given`, `decode` it from bytes, or `publish` it as a cloud.
        kind: name of the message type.
        given: fields or bytes; buffers in fields are written as ("buffer", format, shape, bytes).
    """
    import optipmb_schemas  # noqa: PLC0415  after numpy has been blocked

    model = getattr(optipmb_schemas, kind)
    try:
        if action == "decode":
            message = optipmb_schemas.decode(given, model)
        else:
            fields = {name: read(value) for name, value in given.items()}
            if action == "publish":
                fields["xyz"] = optipmb_schemas.arrays.numeric.finite(
                    optipmb_schemas.arrays.numeric.asarray(fields["xyz"])
                )
            message = model(**fields)
    except optipmb_schemas.MessageError as error:
        return str(error)
    payload = optipmb_schemas.encode(message)
    assert optipmb_schemas.decode(payload, model) == message
    lists = {name: repr(getattr(message, name).tolist()) for name, _ in message.present() if name in message.arrays}
    return payload, optipmb_schemas.encode_json(message), lists, repr(message)


def read(value: Any) -> Any:
    """Give a value whose buffers are written as above."""
    if not (isinstance(value, tuple) and value[:1] == ("buffer",)):
        return value
    _, code, shape, data = value
    if shape == (len(data) // array.array(code).itemsize,):
        return array.array(code, data)
    return memoryview(data).cast(code, shape) if math.prod(shape) else array.array(code)


def publish_everything(make: Callable[..., Any]) -> None:
    """Publish a frame with everything that a frame may have, given as lists and buffers."""
    from optipmb_schemas import FieldOfView  # noqa: PLC0415  as above

    cloud = array.array("f", [1, 2, 3, 9, math.nan, 5, 6, 9, 7, 8, 9, 9])
    with make("garage/robot-1/lidar", cache_clouds=1) as publisher:
        ends = time.monotonic() + 60.0
        while not publisher.points_wanted and time.monotonic() < ends:
            time.sleep(0.01)  # with its end its cache is gone, so who subscribes has to be known before
        publisher.publish(
            stamp_ns=5,
            label=["car", "person"],
            center=[[1, 2, 0.5], (3, 4, 0.5)],
            size=memoryview(array.array("d", [4, 2, 1.5, 0.5, 0.5, 1.8])).cast("B").cast("d", (2, 3)),
            yaw=array.array("f", [0.5, 1.5]),
            score=[0.9, 0.5],
            velocity=[[None, None], [1, 2]],
            pose=([1, 2, 3], [1, 0, 0, 0]),
            field_of_view=FieldOfView(azimuth=[-1, 1], elevation=[-0.5, 0.5], range=[0, 50]),
            position_covariance=[[[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]], [[None] * 3] * 3],
            points=memoryview(cloud).cast("B").cast("f", (3, 4)),
        )
        publisher.publish(stamp_ns=6, label=[], center=[], size=[], yaw=[], score=[], pose=([1, 2, 3], [1, 0, 0, 0]))

"""The threads of Zenoh: how many a message wakes, and their states in the interpreter."""

import ctypes
import threading
from contextlib import suppress
from pathlib import Path

import zenoh
from optipmb_client.zenoh.session import ZenohSession
from routers import free_endpoint, open_client, open_router
from service_process import ServiceProcess

MESSAGES = 50


def test_a_thread_of_the_network_keeps_its_state() -> None:
    """All messages are handed over under one thread state for each thread: none is made and dropped with a message."""
    states: set[tuple[int, int]] = set()
    count = 0
    enough = threading.Event()

    def take(sample: zenoh.Sample) -> None:
        nonlocal count
        del sample
        states.add((threading.get_native_id(), _state()))
        count += 1
        if count == MESSAGES:
            enough.set()

    endpoint = free_endpoint()
    with open_router(endpoint), open_client(endpoint) as receiver, open_client(endpoint) as sender:
        ZenohSession(receiver).listen("some/*/messages", take)
        publisher = sender.declare_publisher("some/other/messages")
        while not enough.wait(0.01):  # one after the other: messages at once would share a state anyway
            publisher.put(b"message")
    assert len(states) == len({thread for thread, _ in states})


def _state() -> int:
    """The number of the thread state of the calling thread, which the interpreter gives to no other one."""
    api = ctypes.pythonapi
    api.PyThreadState_Get.restype = ctypes.c_void_p
    api.PyThreadState_GetID.argtypes = (ctypes.c_void_p,)
    api.PyThreadState_GetID.restype = ctypes.c_uint64
    number: int = api.PyThreadState_GetID(api.PyThreadState_Get())
    return number


def test_one_thread_waits_for_the_router_and_reads() -> None:
    """A service that is a client reads on the thread that waits for the socket, and wakes no other one."""
    with ServiceProcess("router", "--instance", "router") as router:
        router.wait_ready()
        options = ("--connect", router.endpoint, "--instance", "client")
        with ServiceProcess(*options, listen=False, fresh=True) as service:
            service.wait_ready()
            threads = []
            for task in Path(f"/proc/{service.process.pid}/task").iterdir():
                with suppress(OSError):  # the thread has ended
                    threads.append((task / "comm").read_text().strip())
    assert "app-0" in threads
    assert [name for name in threads if name.startswith("rx-")] == []

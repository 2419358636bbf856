"""The command ``armident opcua`` in a process of its own, and questions of a real client."""

import asyncio
import re
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from asyncua import Client, Node, ua
from asyncua.common.events import Event

from armident.identify.opcua.health import NAMES
from armident.identify.opcua.nodes import DI, OWN, ROBOTICS

LONGEST_S = 60


@contextmanager
def serving(config: Path, *words: object, listen: str = "127.0.0.1:0") -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """Run the command; yield its address on loopback."""
    command = [sys.executable, "-m", "armident.daq.cli", "opcua", "--config", config, "--listen", listen, *words]
    with subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.fullmatch(r"opcua: opc\.tcp://\S+:(\d+)/ \(\d cells?\)\n", line)
            assert found, f"{line}{process.stderr.read() if process.stderr else ''}"
            yield f"opc.tcp://127.0.0.1:{found[1]}/", process
        finally:
            process.kill()


def asked(url: str, question: Callable[[Client], Awaitable[Any]]) -> Any:
    """Answer to a question of an anonymous client."""

    async def ask() -> Any:
        async with Client(url, timeout=20) as client:
            return await question(client)

    return asyncio.run(ask())


async def health(client: Client, cell: str) -> dict[str, ua.DataValue]:
    """Readings of the axis of a cell, as clients find them: by browse names from the set of devices."""
    robots, own = [await client.get_namespace_index(uri) for uri in (ROBOTICS, OWN)]
    di = await client.get_namespace_index(DI)
    names = ["MotionDeviceSystem", "MotionDevices", cell, "Axes", "joint_1"]
    path = [f"{di}:DeviceSet", *(f"{robots}:{name}" for name in names), f"{own}:ModelHealth"]
    place = await client.nodes.objects.get_child(path)
    found = {name: await place.get_child(f"{own}:{name}") for name in NAMES}
    return {name: await node.read_data_value(raise_on_bad_status=False) for name, node in found.items()}


class Heard:
    """Changes and events of a subscription."""

    def __init__(self) -> None:
        self.changes: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()
        self.events: asyncio.Queue[Event] = asyncio.Queue()

    def datachange_notification(self, node: Node, value: Any, _: Any) -> None:
        """Take a change."""
        self.changes.put_nowait((str(node.nodeid.Identifier).rpartition("/")[2], value))

    def event_notification(self, event: Event) -> None:
        """Take an event."""
        self.events.put_nowait(event)

import asyncio
import io
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import websockets
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.integration.commands import Trained
from thermoxels_ns.synthetic.scene_truth import look_at

LONGEST_S = 280.0


async def frames_of(port: int, outputs: tuple[str, ...]) -> dict[str, np.ndarray]:
    """What a client sees that chooses one output after the other in the control panel."""
    connection = None
    while connection is None:  # who calls has a limit
        try:
            connection = await websockets.connect(f"ws://127.0.0.1:{port}", max_size=None)
        except OSError:
            await asyncio.sleep(0.5)
    seen: dict[str, np.ndarray] = {}
    pose = look_at((2.0, 2.0, 1.5), (0.0, 0.0, 0.0))
    turn = Rotation.from_matrix(pose[:3, :3] * (1.0, -1.0, -1.0))
    camera: dict[str, Any] = {"type": "ViewerCameraMessage", "fov": 1.0, "aspect": 1.3, "look_at": [0.0, 0.0, 0.0]}
    camera |= {"wxyz": np.roll(turn.as_quat(), 1).tolist(), "position": pose[:3, 3].tolist()}
    camera |= {"up_direction": [0.0, 0.0, 1.0]}

    async def send(message: dict[str, Any]) -> None:
        await connection.send(msgspec.msgpack.encode(message))

    async def until(wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The next message that is wanted."""
        while True:
            raw: Any = await connection.recv()
            decoded = msgspec.msgpack.decode(raw)
            for message in decoded if isinstance(decoded, list) else [decoded]:
                if wanted(message):
                    return message

    async with connection:
        menu = (await until(lambda message: message.get("label") == "Output type"))["id"]
        await send(camera)
        panel = await until(lambda message: message.get("id") == menu and "options" in message.get("updates", {}))
        assert {*outputs} <= {*panel["updates"]["options"]}
        for name in outputs:
            await send({"type": "GuiUpdateMessage", "id": menu, "updates": {"value": name}})
            for _ in range(2):  # the first one may have been under way
                camera["position"][2] += 0.01
                await send(camera)
                picture = await until(lambda message: message["type"] == "BackgroundImageMessage")
            seen[name] = np.asarray(Image.open(io.BytesIO(picture["rgb_bytes"])))
    return seen


def files_below(folder: Path) -> dict[Path, tuple[int, int]]:
    """All that is in a folder, with when it was changed, [ns], and its size."""
    return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in [folder, *folder.rglob("*")]}


def test_every_output_is_drawn_for_who_chooses_it(trained: Trained, tmp_path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    script, log = Path(sys.executable).with_name("ns-viewer"), tmp_path / "log"
    command = [str(script), "--load-config", str(trained.config), "--viewer.websocket-port", str(port)]
    outputs = ("thermal", "temperature_c", "degrees", "depth", "accumulation", "rgb")
    before = files_below(trained.config.parent)
    with log.open("w") as file:
        viewer = subprocess.Popen(
            command, stdout=file, stderr=subprocess.STDOUT, env={**os.environ, "OMP_NUM_THREADS": "1"}
        )
        try:
            seen = asyncio.run(asyncio.wait_for(frames_of(port, outputs), LONGEST_S))
            assert viewer.poll() is None
        finally:
            viewer.kill()
            viewer.wait()
    said = log.read_text()
    assert "Traceback" not in said and "Error" not in said, said
    assert files_below(trained.config.parent) == before, "a run folder that cannot be written to is shown as well"
    assert set(seen) == set(outputs)
    assert all(picture.ndim == 3 and np.ptp(picture) > 20 for picture in seen.values())
    small = {name: np.asarray(Image.fromarray(picture).resize((32, 24)), float) for name, picture in seen.items()}
    assert np.abs(small["thermal"] - small["rgb"]).mean() > 5.0

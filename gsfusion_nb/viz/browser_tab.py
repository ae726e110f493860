"""A map that grows in a browser tab while it is mapped, on this machine or on others in its
network.

The tab is drawn by viser, the extra ``watch``, whose page is served from this machine and loads
nothing else.
"""

import contextlib
import dataclasses
import io
import ipaddress
import logging
import math
import socket
import threading
import time
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from ..drawing.pictures import Picture
from ..errors import ArgumentError, ForeseenError
from ..geometry import quaternion
from ..geometry.upright import world_up
from ..types import Frame, GaussianParams
from .viser_rows import final_rows, records_of, rows_to_show

log = logging.getLogger(__name__)

UPDATE_S = 0.5
"""Shortest time between two updates."""
REST = 20.0
"""After it was read, the map is left alone for this many times as long: 5 % of the time at most."""
CHUNK_ROWS = 8192
"""Rows that are sent together, if one of them has changed."""
_PHOTO_WIDTH = 320
_ORANGE = (255, 150, 30)
_INSTALL = "pip install 'gsfusion-nb[watch]'"
_HELP = "Drag to turn, scroll or pinch to come nearer, right button or two fingers to move."


class WatchUnavailable(ForeseenError, RuntimeError):
    """The extra ``watch`` is not installed, or the address cannot be used; the message says what to
    do."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Moment:
    """What is shown: a copy of what may change."""

    params: GaussianParams
    poses: list[Float[Tensor, "4 4"]]
    frame: Frame
    words: str


class BrowserTab:
    """Shows a run while it maps: pass it as ``watch`` to ``run_mapping``, ``resume_mapping`` or
    ``map_stream``.

    The Gaussians, the way of the camera, and the present frame with its photograph are updated at
    most twice a second. Only parts that changed are sent. A map of GPS-SLAM is shown with its
    surface as discs. Colours are those from the front, without what depends on the view.

        with BrowserTab() as tab:
            print(tab.url)
            run_mapping("room", watch=tab)
            tab.wait()

    Args:
        host: Address to listen at. By default only programs on this machine see the tab; "0.0.0.0"
            lets everyone in the network see it.
        port: Port to listen at; if it is taken, the next free one.

    Raises:
        WatchUnavailable: viser is not installed, or the address is not one of this machine.
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int = 8080):
        if not 0 < port < 65536:
            raise ArgumentError(f"port must be between 1 and 65535, got {port}")
        self.host = host
        self.server: Any = _started(host, port)
        self.n_updates = 0
        """How often the tab was updated."""
        self._chunks: list[np.ndarray] = []
        self._handles: dict[str, Any] = {}
        self._text = self.server.gui.add_markdown(f"Waiting for the first frame. {_HELP}")
        self._photo: Any = None
        self._last_frame: Frame | None = None
        self._n_frames = 0
        self._next_s = -math.inf
        self._waiting: _Moment | None = None
        self._wanted = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="browser-tab", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port that it listens at."""
        return self.server.get_port()

    @property
    def url(self) -> str:
        """Address of the tab, for a browser on this machine, or in the network if others may see
        it."""
        host = self.host if not _is_any(self.host) else own_address()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}"

    @property
    def is_private(self) -> bool:
        """Whether only programs on this machine can open it."""
        return _is_loopback(self.host)

    def who_sees(self) -> str:
        """Who can open the tab, in words."""
        if self.is_private:
            return "only programs on this machine can open it"
        return (
            "everyone whose device reaches this address sees the map and the camera's pictures, "
            "without a password"
        )

    def frame_mapped(self, mapper: Any, frame: Frame, report: Any) -> None:
        """Called by the run after each frame."""
        self._last_frame = frame
        self._n_frames += 1
        self._show(mapper, f"frame {self._n_frames}: {report.in_words}")

    def optimised(self, mapper: Any, step: Any) -> None:
        """Called by the run after each step of the optimisation after the scan."""
        self._show(
            mapper,
            f"optimising, step {step.step} of {step.n_steps}: {len(mapper.gaussians):,} Gaussians",
        )

    def finished(self, mapper: Any, mesh: Any, metrics: dict[str, Any]) -> None:
        """Called by the run at its end: the final map is shown."""
        psnr_db = metrics.get("psnr_held_out_db")
        score = f", PSNR of held-out views {psnr_db:.1f} dB" if isinstance(psnr_db, float) else ""
        self._show(mapper, f"finished: {len(mapper.gaussians):,} Gaussians{score}", now=True)

    def wait(self) -> None:
        """Wait until Ctrl-C; the tab goes on showing the map."""
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            return

    def close(self) -> None:
        """Show what is still to be shown, then close the address."""
        with self._wanted:
            self._closed = True
            self._wanted.notify()
        self._thread.join(timeout=10.0)
        with contextlib.redirect_stdout(io.StringIO()):  # viser says that it has stopped
            self.server.stop()

    def __enter__(self) -> "BrowserTab":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _show(self, mapper: Any, words: str, *, now: bool = False) -> None:
        """Copy the map for the thread that sends it, unless it was copied a moment ago."""
        began = time.monotonic()
        if self._last_frame is None or (began < self._next_s and not now):
            return
        with self._wanted:
            if self._waiting is not None and not now:
                return
        params = mapper.files.standard_gaussians()
        moment = _Moment(
            params=final_rows(params) if now else rows_to_show(params),
            poses=list(mapper.trajectory.poses),
            frame=self._last_frame,
            words=words,
        )
        with self._wanted:
            self._waiting = moment
            self._wanted.notify()
        spent_s = time.monotonic() - began
        self._next_s = began + max(UPDATE_S, REST * spent_s)

    def _work(self) -> None:
        """Send the newest moment; a moment that comes while another is sent takes its turn."""
        while True:
            with self._wanted:
                while self._waiting is None and not self._closed:
                    self._wanted.wait()
                moment = self._waiting
                if moment is None:
                    return
            try:
                with self.server.atomic():
                    self._send(moment)
                self.server.flush()
            except Exception as e:  # mapping goes on
                log.warning("the tab in the browser is not updated any more: %s", e)
                return
            self.n_updates += 1
            with self._wanted:
                if self._waiting is moment:
                    self._waiting = None

    def _send(self, moment: _Moment) -> None:
        if not self._handles:
            self._look_at_start(moment)
        records = records_of(moment.params)
        chunks = [records[k : k + CHUNK_ROWS] for k in range(0, len(records), CHUNK_ROWS)]
        for number, chunk in enumerate(chunks):
            if number >= len(self._chunks) or not np.array_equal(chunk, self._chunks[number]):
                self._send_chunk(f"/map/{number}", chunk)
        for number in range(len(chunks), len(self._chunks)):
            self._handles.pop(f"/map/{number}").remove()
        self._chunks = chunks
        self._send_camera(moment)
        self._text.content = f"{moment.words}\n\n{_HELP}"

    def _send_chunk(self, name: str, chunk: np.ndarray) -> None:
        self._handles[name] = self.server.scene.add_gaussian_splats(
            name,
            centers=chunk["xyz"],
            covariances=chunk["covariance"].astype(np.float32),
            rgbs=chunk["rgb"],
            opacities=chunk["opacity"],
        )

    def _send_camera(self, moment: _Moment) -> None:
        """The way of the camera, where it is now, and what it sees."""
        centres = np.stack([T[:3, 3].cpu().numpy() for T in moment.poses]).astype(np.float32)
        scene = self.server.scene
        if len(centres) > 1:
            segments = np.stack([centres[:-1], centres[1:]], axis=1)
            self._handles["/path"] = scene.add_line_segments(
                "/path", segments, _ORANGE, thickness=3.0, thickness_units="screen"
            )
        picture = _small(moment.frame)
        camera = moment.frame.camera
        T_WC = moment.poses[-1].cpu().float()
        self._handles["/camera"] = scene.add_camera_frustum(
            "/camera",
            fov=2 * math.atan(0.5 * camera.height / camera.fy),
            aspect=camera.width / camera.height,
            scale=0.1,
            thickness=0.006,
            color=_ORANGE,
            image=picture,
            format="jpeg",
            wxyz=quaternion.from_matrix(T_WC[:3, :3]).numpy(),
            position=T_WC[:3, 3].numpy(),
        )
        if self._photo is None:
            self._photo = self.server.gui.add_image(picture, label="Camera", format="jpeg")
        else:
            self._photo.image = picture

    def _look_at_start(self, moment: _Moment) -> None:
        """Put the viewer a step behind and above the camera, looking where it looks."""
        up_W = world_up(moment.poses)
        T_WC = moment.poses[0].cpu().float()
        self.server.scene.set_up_direction(tuple(up_W.tolist()))
        start = self.server.initial_camera
        start.position = tuple((T_WC[:3, 3] - 0.5 * T_WC[:3, 2] + 0.2 * up_W).tolist())
        start.look_at = tuple((T_WC[:3, 3] + 1.5 * T_WC[:3, 2]).tolist())
        start.up = tuple(up_W.tolist())


def _started(host: str, port: int) -> Any:
    try:
        import viser
    except ImportError as e:
        raise WatchUnavailable(
            f"a map in a browser tab needs {e.name!r}, which is not installed: {_INSTALL}"
        ) from None
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as trial:
            trial.bind((host, 0))
    except OSError as e:
        raise WatchUnavailable(
            f"{host} is no address of this machine ({e.strerror or e}); 127.0.0.1 is for this "
            "machine alone, 0.0.0.0 for its whole network"
        ) from None
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints the address, and we do
        server = viser.ViserServer(host=host, port=port, label="gsfusion_nb", verbose=False)
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    return server


def own_address() -> str:
    """Address of this machine in its network; nothing is sent to find it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.connect(("192.0.2.1", 9))  # an address for documentation, which no machine has
            return trial.getsockname()[0]
        except OSError:
            return socket.gethostname()


def _is_any(host: str) -> bool:
    return host in ("0.0.0.0", "::")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _small(frame: Frame) -> Picture:
    picture = frame.rgb_u8.cpu().numpy()
    height = round(_PHOTO_WIDTH * frame.camera.height / frame.camera.width)
    small = cv2.resize(picture, (_PHOTO_WIDTH, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)

"""A live view of online mapping: the panels of each frame, curves, and the camera's place in a
map."""

import contextlib
import dataclasses
import html
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..drawing.encoding import encode_jpeg
from ..drawing.pictures import Picture, side_by_side
from ..runs import MappingRun
from ..runs.mapping_run import lost_in_words
from ..types import Frame, GaussianParams
from .live import LivePictures
from .map_from_above import PLACE, drawable, map_from_above, stacked
from .mapped_frame import captions_of, live_panels, mosaic
from .player import WAITING, take_the_stage
from .splat_viewer import SplatViewer


class LiveMapper(LivePictures):
    """Runs the online part of a ``MappingRun`` frame by frame in its own thread; other cells can
    run meanwhile.

    The last line of a cell shows it. From Python: ``player.start()``, ``pause``, ``step``,
    ``stop``, and ``run_sync(n)``, which maps ``n`` frames (or all that are left) in the calling
    cell. ``lock`` is held during a step; pass it to any code that reads the maps at the same time.
    Making another ``LiveMapper`` stops this one, so running a cell twice does not leave the first
    run going unseen.

    Args:
        run: The run; it may have mapped some frames already.
        panel_width: Width of each panel on screen, pixels.

    ``splats()`` makes a splat viewer that follows the map; show it in a cell of its own. The slider
    ``frame`` goes back through the frames that were mapped.

    A run in the map of another (``stream_onto``) has a panel more: the map from above, with the
    camera in it once it is located.
    """

    def __init__(self, run: MappingRun, *, panel_width: int = 320):
        take_the_stage(self)
        self.run = run
        self.viewer: SplatViewer | None = None
        """The splat viewer made by ``splats``; it is updated together with the panels."""
        self.panels: dict[str, Picture] = {}
        self._last_stored = run.next_position
        self._seen_from_above: GaussianParams | None = None
        n = len(run.sequence.mapping)
        captions = captions_of(run.mapper) | ({"place": PLACE} if run.parent else {})
        super().__init__(
            self._frames, captions, name="live", what="frame", n_steps=n, width=panel_width
        )
        if run.parent:
            self.images["place"].show(self._place())
        self._write_status()

    def _frames(self) -> Iterator[Any]:
        with contextlib.closing(self.run.frame_by_frame()) as reports:
            for report in reports:
                yield WAITING if report is None else report

    def stop(self) -> None:
        """Stop after the current frame."""
        self.player.stop()

    def splats(self, **options: Any) -> SplatViewer:
        """A splat viewer that is updated while the map grows; ``options`` are those of
        ``SplatViewer``.

        Its time slider shows the map as it was at earlier frames. After another call only the newer
        viewer follows the map.
        """
        if not len(self.run.mapper.keyframes) and len(self.run.sequence.mapping):  # no keyframe yet
            first = self.run.sequence.mapping[0]
            options = {"camera": first.camera, "T_WC": first.T_WC} | options
        self.viewer = SplatViewer(self.run.mapper, lock=self.lock, **options)
        return self.viewer

    def __repr__(self) -> str:
        return f"LiveMapper({self.run!r})"

    def _series(self) -> Mapping[str, Sequence[float | int]]:
        return {
            title: [value(s) for s in self.run.steps]
            for title, value in self.run.mapper.description.curves.items()
        }

    def _mosaic(self) -> Picture | None:
        panels = None
        if self.panels:
            small = next(iter(self.panels.values())).shape[1]
            panels = mosaic(
                self.panels,
                captions_of(self.run.mapper),
                max(1, round(self._panel_width / small)),
            )
        if not self.run.parent:
            return panels
        place = side_by_side([self._place()], [PLACE])
        return place if panels is None else stacked(panels, place)

    def _place(self) -> Picture:
        """Where the camera is in the map of the earlier run."""
        poses = self.run.mapper.trajectory.poses
        n_earlier = self.run.n_earlier
        size = (self._panel_width, 3 * self._panel_width // 4)
        mapper = self.run.mapper
        if "base" in mapper.description.panels:  # its surface takes longer: drawn as it began
            self._seen_from_above = self._seen_from_above or drawable(mapper)
        params = self._seen_from_above or drawable(mapper)
        return map_from_above(params, poses[:n_earlier], poses[n_earlier:], size)

    def _draw(self) -> None:
        super()._draw()
        if self.viewer is not None and self.player.error is None:
            self.viewer.update(self.run.mapper)

    def _keep(self) -> None:
        if self._last_stored == self.run.next_position:
            return
        self._last_stored = self.run.next_position
        self.panels = live_panels(self.run.mapper, self._last_frame())
        shown = self.panels | ({"place": self._place()} if self.run.parent else {})
        pictures = {name: encode_jpeg(shown[name]) for name in self.images}
        self.scrubber.add((len(self.run.steps), pictures))

    def _last_frame(self) -> Frame:
        """The frame mapped last, with the pose it was mapped at."""
        frame = self.run.sequence.mapping[self.run.next_position - 1]
        trajectory = self.run.mapper.trajectory
        # frames after it were skipped
        if not trajectory.poses or trajectory.frame_indices[-1] != frame.index:
            return frame
        return dataclasses.replace(frame, T_WC=trajectory.poses[-1].to(frame.T_WC))

    def _words(self) -> list[str]:
        self.progress.value = self.run.next_position
        run = self.run
        title = run.mapper.description.title
        fidelity = run.mapper.description.fidelity_of(run.mapper.config)
        words = [
            f"{title} ({html.escape(fidelity)})" if fidelity else title,
            f"{run.next_position} of {len(run.sequence.mapping)} frames",
            html.escape(lost_in_words(run)),
        ]
        at = len(run.steps) if self.scrubber.following else self._shown_step
        if not at:
            return words
        last = run.steps[at - 1]
        recent = run.steps[max(at - 10, 0) : at]
        prefix = "" if at == len(run.steps) else "looking back at "
        has_psnr = not math.isnan(last.psnr_before_db + last.psnr_after_db)
        return [
            *words,
            f"{prefix}frame {last.frame_index}{' (keyframe)' if last.is_keyframe else ''}",
            f"{last.n_seeds:,} new Gaussians",
            f"PSNR {last.psnr_before_db:.1f} → {last.psnr_after_db:.1f} dB" if has_psnr else "",
            f"{len(recent) / max(sum(s.total_seconds for s in recent), 1e-9):.1f} frames/s",
        ]

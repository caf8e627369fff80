"""One browser: connects the panel's controls and the mouse to an inspection, and sends it
pictures."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser

from mrgs.errors import ConfigError, MrgsError
from mrgs.scene import Camera, in_order
from mrgs.viewer import texts
from mrgs.viewer.cameras import Pose, pinhole, pose_at, rotation_wxyz, vertical_fov
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.panel import build_panel
from mrgs.viewer.scheduler import RenderScheduler
from mrgs.viewer.settings import Subject
from mrgs.viewer.splats import BrowserSplats, covariances, splat_colors

COARSE_JPEG_QUALITY = 70
SHARP_JPEG_QUALITY = 90
FRUSTUM_SCALE = 0.06
"""Length of a camera's symbol, as a share of the scene's extent."""

ERROR_COLOR = "#b91c1c"

_log = logging.getLogger(__name__)


class Browser:
    """Everything of one connected browser; its state is ``inspection``.

    Args:
        client: viser's handle of it.
        subject: the model to show.
        start: first viewpoint.
        note: a sentence for the top of the panel; may be empty.
        splats: the model as plain splats, for the browser to draw; None if that is not possible.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        subject: Subject,
        start: Pose,
        note: str,
        splats: BrowserSplats | None,
    ) -> None:
        self._client = client
        self._subject = subject
        self.inspection = Inspection(subject)
        self._splats = splats
        self._panel = build_panel(client.gui, self.inspection, note, splats is not None)
        self._scheduler = RenderScheduler(self._draw, self._report)
        self._frustums: list[Any] = []
        self._splat_node: Any = None
        self._go_to(start)
        self._connect()
        self._scheduler.moved()

    def close(self) -> None:
        """Stop drawing for this browser; a picture that is being drawn is finished."""
        self._scheduler.close()

    @property
    def drawing(self) -> bool:
        """Whether a picture is due, or being drawn."""
        return self._scheduler.busy

    def refresh(self) -> None:
        """Redraw, because the model has changed."""
        if not self.drawing:
            self._scheduler.refresh()

    def set_note(self, note: str) -> None:
        """Replace the sentence at the top of the panel."""
        self._panel.header.content = texts.header(self._subject, note)

    def _connect(self) -> None:
        panel, client = self._panel, self._client
        client.camera.on_update(self._moved)
        client.scene.on_click()(self._contained(self._clicked))
        for control in panel.pictures():
            control.on_update(self._contained(self._changed))
        panel.browser_splats.on_update(self._contained(self._changed))
        panel.photo.on_update(self._contained(self._photo_chosen))
        panel.show_cameras.on_update(self._contained(self._show_cameras))
        panel.previous.on_click(self._contained(lambda _: self._step_photo(-1)))
        panel.next.on_click(self._contained(lambda _: self._step_photo(1)))
        panel.keep_spot.on_click(self._contained(self._keep_spot))
        panel.draw_box.on_click(self._contained(self._arm_box))
        panel.clear_marks.on_click(self._contained(self._clear_marks))
        panel.screenshot.on_click(self._contained(self._screenshot))
        panel.add_keyframe.on_click(self._contained(self._add_keyframe))
        panel.clear_path.on_click(self._contained(self._clear_path))
        panel.save_path.on_click(self._contained(self._save_path))
        panel.render_video.on_click(self._contained(self._render_video))

    async def _moved(self, _: viser.CameraHandle) -> None:
        """The camera has moved. Being asynchronous, it runs on the server's own thread, whose time
        it accounts for."""
        self._subject.source.charge()
        self._scheduler.moved()

    def _contained(self, action: Callable[[Any], None]) -> Callable[[Any], None]:
        """The action; what it raises becomes a line in the panel."""

        def run(event: Any) -> None:
            try:
                action(event)
            except Exception as error:
                self._report(error)

        return run

    def _report(self, error: Exception) -> None:
        if not isinstance(error, MrgsError):
            _log.warning("the viewer failed: %r", error, exc_info=error)
        self._say(str(error) or repr(error), ERROR_COLOR)

    def _say(self, text: str, color: str = "inherit") -> None:
        self._panel.status.content = texts.paragraph(text, color)

    def _say_saved(self, path: Path) -> None:
        self._say(f"Saved in the run's folder: {path.relative_to(self._subject.folder).as_posix()}")

    def _camera(self) -> Camera:
        camera = self._client.camera
        return pinhole(
            np.asarray(camera.wxyz), np.asarray(camera.position), float(camera.fov),
            max(camera.image_width, 1),
            max(camera.image_height, 1),
        )  # fmt: skip

    def _draw(self, coarse: bool) -> None:
        """Draw and send a picture; on the scheduler's thread."""
        if self._panel.browser_splats.value and self._splats is not None:
            return
        inspection = self.inspection
        image = inspection.picture(self._camera(), coarse)
        quality = COARSE_JPEG_QUALITY if coarse else SHARP_JPEG_QUALITY
        self._client.scene.set_background_image(image, format="jpeg", jpeg_quality=quality)
        if coarse:
            return
        panel = self._panel
        scale = inspection.scales.values.get(panel.scaled)
        if panel.automatic.value and scale is not None:
            panel.lowest.value, panel.highest.value = round(scale.low, 2), round(scale.high, 2)
        panel.boxes.content = texts.boxes(
            inspection.box_readings, inspection.measured, self._subject
        )
        if inspection.view is not None and panel.photo.value != inspection.view.name:
            panel.photo.value = inspection.view.name
        for index, frustum in enumerate(self._frustums):  # the nearest one would stand in the way
            frustum.visible = index != inspection.view_index

    def _changed(self, event: Any) -> None:
        if event.client is None:  # set by the program, to follow the picture
            return
        inspection, panel = self.inspection, self._panel
        inspection.settings = panel.settings()
        panel.show_relevant(inspection.settings)
        if panel.browser_splats.value and self._splats is not None:
            self._draw_in_browser()
            return
        if self._splat_node is not None:
            self._splat_node.remove()
            self._splat_node = None
        self._place_frustums()
        self._scheduler.refresh()

    def _draw_in_browser(self) -> None:
        assert self._splats is not None
        mode = self.inspection.settings.mode
        if mode.kind != "image":
            self._panel.browser_splats.value = False
            shown = " or ".join(each.quantity for each in in_order(self._subject.modalities))
            raise ConfigError(f"the browser can draw {shown}, not: {mode.label}")
        self._say("Sending the model to the browser ...")
        baked = self._splats.baked()
        opacities = baked.opacities[mode.modalities[0]]
        self._splat_node = self._client.scene.add_gaussian_splats(
            "/splats",
            centers=baked.means.numpy(),
            covariances=covariances(baked.quats, baked.scales).numpy(),
            rgbs=splat_colors(baked, self.inspection.settings, self.inspection.scales) / 255,
            opacities=opacities.numpy()[:, None],
        )
        self._client.scene.set_background_image(np.zeros((2, 2, 3), np.uint8))
        self._say("Drawn by the browser.")

    def _clicked(self, event: Any) -> None:
        x, y = event.screen_pos
        if self._panel.browser_splats.value:
            self.inspection.picture(self._camera(), coarse=True)
        reading = self.inspection.click(float(x), float(y))
        self._panel.point.content = texts.point(self.inspection)
        self._say(texts.EMPTY_HINT if reading is None else "")
        self._scheduler.refresh()

    def _keep_spot(self, _: Any) -> None:
        self.inspection.keep_spot()
        self._marks_changed()

    def _clear_marks(self, _: Any) -> None:
        self.inspection.clear()
        self._marks_changed()

    def _marks_changed(self) -> None:
        self._panel.spots.content = texts.spots(self.inspection)
        self._panel.point.content = texts.point(self.inspection)
        self._scheduler.refresh()

    def _arm_box(self, _: Any) -> None:
        scene = self._client.scene
        scene.remove_rect_select_callback("all")  # pressed twice

        def selected(event: Any) -> None:
            scene.remove_rect_select_callback("all")
            self._say("")
            self.inspection.add_box(
                *(float(value) for value in (*event.screen_min, *event.screen_max))
            )
            self._scheduler.refresh()

        scene.on_rect_select()(self._contained(selected))
        self._say("Now drag over the picture to draw the box.")

    def _photo_chosen(self, event: Any) -> None:
        if event.client is not None:
            self._go_to_photo(
                [view.name for view in self._subject.views].index(self._panel.photo.value)
            )

    def _step_photo(self, step: int) -> None:
        views = self._subject.views
        index = [view.name for view in views].index(self._panel.photo.value) + step
        self._go_to_photo(index % len(views))

    def _go_to_photo(self, index: int) -> None:
        views = self._subject.views
        self.inspection.view_index = index
        self._panel.photo.value = views[index].name
        self._go_to(pose_at(views[index], views))
        self._scheduler.refresh()

    def _go_to(self, pose: Pose) -> None:
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction = pose.up
            camera.position = pose.position
            camera.look_at = pose.target
            camera.fov = pose.fov

    def _show_cameras(self, _: Any) -> None:
        self._place_frustums()

    def _place_frustums(self) -> None:
        """Symbols of the captured cameras, where the picture is one undivided view."""
        mode = self.inspection.settings.mode
        undivided = not mode.shows_photos and mode.kind != "side_by_side"
        wanted = self._panel.show_cameras.value and undivided
        if wanted == bool(self._frustums):
            return
        for frustum in self._frustums:
            frustum.remove()
        self._frustums = []
        scene = self._subject.scene
        if not wanted or scene is None:
            return
        for index, view in enumerate(self._subject.views):
            camera = view.camera
            frustum = self._client.scene.add_camera_frustum(
                f"/cameras/{index}", vertical_fov(camera), camera.width / camera.height,
                scale=FRUSTUM_SCALE * scene.extent, color=(255, 170, 0), thickness=1.5,
                thickness_units="screen",
                wxyz=rotation_wxyz(camera),
                position=camera.position.numpy(),
            )  # fmt: skip
            frustum.visible = index != self.inspection.view_index
            frustum.on_click(self._contained(self._goes_to(index)))
            self._frustums.append(frustum)

    def _goes_to(self, index: int) -> Callable[[Any], None]:
        return lambda _: self._go_to_photo(index)

    def _screenshot(self, _: Any) -> None:
        self._say_saved(self.inspection.screenshot())

    def _add_keyframe(self, _: Any) -> None:
        self.inspection.add_keyframe()
        self._path_changed()

    def _clear_path(self, _: Any) -> None:
        self.inspection.keyframes = ()
        self._path_changed()

    def _path_changed(self) -> None:
        count = len(self.inspection.keyframes)
        text = {0: "No keyframes yet.", 1: "1 keyframe; add at least one more."}.get(
            count, f"{count} keyframes."
        )
        self._panel.keyframes.content = texts.paragraph(text)

    def _save_path(self, _: Any) -> None:
        self._say_saved(self.inspection.save_path(self._panel.seconds.value))

    def _render_video(self, _: Any) -> None:
        panel = self._panel
        panel.render_video.disabled = True
        try:
            path = self.inspection.render_video(
                panel.seconds.value,
                lambda done, total: self._say(f"Rendering frame {done} of {total} ..."),
            )
            self._say_saved(path)
        finally:
            panel.render_video.disabled = False

"""The panel's controls: what stands where, in the words of its users. What the controls do is in
``browser.py``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import viser

from mrgs.viewer import texts
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.settings import MODE_LABELS, PALETTE_CHOICES, Mode, Settings, Subject

_MODES: dict[str, Mode] = {label: mode for mode, label in MODE_LABELS.items()}
DEFAULT_SECONDS = 8.0


@dataclass(frozen=True, eq=False)
class Panel:
    """The handles of the controls; those of a modality or a capture that is not there are hidden,
    not missing."""

    header: viser.GuiHtmlHandle
    point: viser.GuiHtmlHandle
    status: viser.GuiHtmlHandle
    mode: viser.GuiDropdownHandle[str]
    share: viser.GuiSliderHandle[int]
    palette: viser.GuiDropdownHandle[str]
    automatic: viser.GuiCheckboxHandle
    coldest: viser.GuiNumberHandle[float]
    hottest: viser.GuiNumberHandle[float]
    marks_band: viser.GuiCheckboxHandle
    band_from: viser.GuiNumberHandle[float]
    band_to: viser.GuiNumberHandle[float]
    browser_splats: viser.GuiCheckboxHandle
    screenshot: viser.GuiButtonHandle
    keep_spot: viser.GuiButtonHandle
    draw_box: viser.GuiButtonHandle
    clear_marks: viser.GuiButtonHandle
    spots: viser.GuiHtmlHandle
    boxes: viser.GuiHtmlHandle
    photo: viser.GuiDropdownHandle[str]
    previous: viser.GuiButtonHandle
    next: viser.GuiButtonHandle
    show_cameras: viser.GuiCheckboxHandle
    add_keyframe: viser.GuiButtonHandle
    clear_path: viser.GuiButtonHandle
    seconds: viser.GuiNumberHandle[float]
    save_path: viser.GuiButtonHandle
    render_video: viser.GuiButtonHandle
    keyframes: viser.GuiHtmlHandle

    def settings(self) -> Settings:
        """What the controls say."""
        limits = band = None
        if not self.automatic.value and self.coldest.value != self.hottest.value:
            limits = (
                min(self.coldest.value, self.hottest.value),
                max(self.coldest.value, self.hottest.value),
            )
        if self.marks_band.value:
            band = (self.band_from.value, self.band_to.value)
        palette = next(name for name in PALETTE_CHOICES if name == self.palette.value)
        return Settings(_MODES[self.mode.value], palette, limits, band, self.share.value / 100)

    def pictures(self) -> tuple[Any, ...]:
        """The controls that change the picture."""
        return (
            self.mode, self.share, self.palette, self.automatic, self.coldest, self.hottest,
            self.marks_band,
            self.band_from, self.band_to,
        )  # fmt: skip

    def show_relevant(self, settings: Settings) -> None:
        """Show what matters for the mode, and enable what can be used."""
        self.share.visible = settings.mode in ("blend", "split")
        self.coldest.disabled = self.hottest.disabled = self.automatic.value
        self.band_from.visible = self.band_to.visible = self.marks_band.value


def build_panel(gui: viser.GuiApi, inspection: Inspection, note: str, can_bake: bool) -> Panel:
    """Build the controls for one browser.

    Args:
        gui: of the browser.
        inspection: what the browser looks at.
        note: a sentence at the top; may be empty.
        can_bake: whether the browser can be given the splats themselves.
    """
    subject = inspection.subject
    handles: dict[str, Any] = {
        "header": gui.add_html(texts.header(subject, note)),
        "point": gui.add_html(texts.point(inspection)),
        "status": gui.add_html(texts.paragraph("")),
    }
    tabs = gui.add_tab_group()
    with tabs.add_tab("View"):
        handles |= _view_tab(gui, subject, can_bake)
    with tabs.add_tab("Measure"):
        handles |= _measure_tab(gui, inspection)
    with tabs.add_tab("Photos"):
        handles |= _photos_tab(gui, subject)
    with tabs.add_tab("Video"):
        handles |= _video_tab(gui)
    panel = Panel(**handles)
    panel.show_relevant(panel.settings())
    return panel


def _view_tab(gui: viser.GuiApi, subject: Subject, can_bake: bool) -> dict[str, Any]:
    scale, unit, thermal = subject.temperature, subject.unit, subject.has_thermal
    low, high = (0.0, 1.0) if scale is None else (scale.min_c, scale.max_c)
    step = 0.01 if scale is None else 0.1
    handles: dict[str, Any] = {
        "mode": gui.add_dropdown("Show", [MODE_LABELS[mode] for mode in subject.modes]),
        "share": gui.add_slider(
            "Temperature, %", 0, 100, 1, 50, hint="0: all colour. 100: all temperature."
        ),
    }
    with gui.add_folder("Temperature scale", visible=thermal):
        handles["palette"] = gui.add_dropdown("Palette", PALETTE_CHOICES)
        handles["automatic"] = gui.add_checkbox(
            "Automatic",
            True,
            hint="The range follows the picture. Switch it off to set the range by hand.",
        )
        handles["coldest"] = gui.add_number(f"Coldest, {unit}", low, step=step)
        handles["hottest"] = gui.add_number(f"Hottest, {unit}", high, step=step)
        handles["marks_band"] = gui.add_checkbox(
            "Isotherm", False, hint="Marks all temperatures from-to in one bright colour."
        )
        handles["band_from"] = gui.add_number(
            f"From, {unit}", round(low + 0.6 * (high - low), 2), step=step
        )
        handles["band_to"] = gui.add_number(f"To, {unit}", round(high, 2), step=step)
    handles["browser_splats"] = gui.add_checkbox(
        "Let the browser draw", False, visible=can_bake,
        hint="Smooth, but needs a graphics card. Colour or temperature only; clicking reads as "
             "before.",
    )  # fmt: skip
    handles["screenshot"] = gui.add_button("Screenshot", icon="camera")
    return handles


def _measure_tab(gui: viser.GuiApi, inspection: Inspection) -> dict[str, Any]:
    return {
        "keep_spot": gui.add_button(
            "Keep the point as a "
            "spot", icon="map-pin", hint="A spot stays on the object with the value that was read."
        ),
        "spots": gui.add_html(texts.spots(inspection)),
        "draw_box": gui.add_button(
            "Draw a box", icon="square", hint="Press, then drag over the picture. A box stays in "
                                              "the picture.",
            visible=inspection.subject.has_thermal,
        ),
        "boxes": gui.add_html(
            texts.boxes((), inspection.subject), visible=inspection.subject.has_thermal
        ),
        "clear_marks": gui.add_button("Remove all spots and boxes", icon="trash"),
    }  # fmt: skip


def _photos_tab(gui: viser.GuiApi, subject: Subject) -> dict[str, Any]:
    names = [view.name for view in subject.views]
    there = bool(names)
    if there:
        text = (
            "Go to where a photo was taken. 'Photos beside the model' and 'Difference' are "
            "under View, Show."
        )
    else:
        text = "The photos are not at hand: name the scene's folder with --scene."
    gui.add_html(texts.paragraph(text, "#6b7280"))
    return {
        "photo": gui.add_dropdown("Photo", names or ["-"], visible=there),
        "previous": gui.add_button("Previous photo", icon="arrow-left", visible=there),
        "next": gui.add_button("Next photo", icon="arrow-right", visible=there),
        "show_cameras": gui.add_checkbox(
            "Show the cameras", False, visible=there, hint="Click on a camera to go there."
        ),
    }


def _video_tab(gui: viser.GuiApi) -> dict[str, Any]:
    gui.add_html(
        texts.paragraph(
            "Go to a place, add a keyframe, go to the next. The video flies through them.",
            "#6b7280",
        )
    )
    return {
        "add_keyframe": gui.add_button("Add keyframe", icon="plus"),
        "keyframes": gui.add_html(texts.paragraph("No keyframes yet.", "#6b7280")),
        "seconds": gui.add_number("Seconds", DEFAULT_SECONDS, min=0.5, max=600.0, step=0.5),
        "render_video": gui.add_button("Render video", icon="movie"),
        "save_path": gui.add_button(
            "Save the path", icon="device-floppy", hint="As nerfstudio's camera-path JSON."
        ),
        "clear_path": gui.add_button("Remove all keyframes", icon="trash"),
    }

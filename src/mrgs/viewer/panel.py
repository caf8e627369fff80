"""The panel's controls and their labels; ``browser.py`` connects them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import viser

from mrgs.pictures.values import NORMALISED, range_of, unit_of
from mrgs.scene import THERMAL, Modality
from mrgs.viewer import texts
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.settings import PALETTE_CHOICES, Mode, Settings, Subject

DEFAULT_SECONDS = 8.0


@dataclass(frozen=True, eq=False)
class ControlPanel:
    """The handles of the controls; those of a missing modality or capture are hidden.

    Attributes:
        modes: by their labels in the dropdown ``mode``.
        scaled: the modality that the range and the isotherm apply to.
    """

    modes: dict[str, Mode]
    scaled: Modality
    header: viser.GuiHtmlHandle
    point: viser.GuiHtmlHandle
    status: viser.GuiHtmlHandle
    mode: viser.GuiDropdownHandle[str]
    share: viser.GuiSliderHandle[int]
    palette: viser.GuiDropdownHandle[str]
    automatic: viser.GuiCheckboxHandle
    lowest: viser.GuiNumberHandle[float]
    highest: viser.GuiNumberHandle[float]
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
        """The current choices of the controls."""
        limits = band = None
        lowest, highest = sorted((self.lowest.value, self.highest.value))
        if not self.automatic.value and lowest < highest:
            limits = (lowest, highest)
        if self.marks_band.value:
            band = (self.band_from.value, self.band_to.value)
        palette = next(name for name in PALETTE_CHOICES if name == self.palette.value)
        share = self.share.value / 100
        return Settings(self.modes[self.mode.value], palette, limits, band, share, self.scaled)

    def pictures(self) -> tuple[Any, ...]:
        """The controls that change the picture."""
        return (
            self.mode, self.share, self.palette, self.automatic, self.lowest, self.highest,
            self.marks_band,
            self.band_from, self.band_to,
        )  # fmt: skip

    def show_relevant(self, settings: Settings) -> None:
        """Show what matters for the mode, and enable what can be used."""
        self.share.visible = settings.mode.has_slider
        self.lowest.disabled = self.highest.disabled = self.automatic.value
        self.band_from.visible = self.band_to.visible = self.marks_band.value


def build_panel(
    gui: viser.GuiApi, inspection: Inspection, note: str, can_bake: bool
) -> ControlPanel:
    """Build the controls for one browser.

    Args:
        gui: of the browser.
        inspection: the browser's state.
        note: a sentence at the top; may be empty.
        can_bake: whether the browser can be given the splats themselves.
    """
    subject = inspection.subject
    handles: dict[str, Any] = {
        "modes": {mode.label: mode for mode in reversed(subject.modes)},
        "scaled": subject.scaled or THERMAL,
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
    panel = ControlPanel(**handles)
    panel.show_relevant(panel.settings())
    return panel


def _view_tab(gui: viser.GuiApi, subject: Subject, can_bake: bool) -> dict[str, Any]:
    pairs = [mode.modalities for mode in subject.modes if mode.has_slider]
    lower = pairs[0][0].quantity if pairs else ""
    upper = pairs[0][1].quantity if len({above for _, above in pairs}) == 1 else "second image"
    handles: dict[str, Any] = {
        "mode": gui.add_dropdown("Show", [mode.label for mode in subject.modes]),
        "share": gui.add_slider(
            f"{upper[:1].upper()}{upper[1:]}, %", 0, 100, 1, 50,
            hint=f"0: all {lower}. 100: all {upper}.",
        ),
        **_scale_folder(gui, subject),
    }  # fmt: skip
    handles["browser_splats"] = gui.add_checkbox(
        "Let the browser draw", False, visible=can_bake,
        hint="Smooth, but needs a graphics card. One image at a time; clicking reads as before.",
    )  # fmt: skip
    handles["screenshot"] = gui.add_button("Screenshot", icon="camera")
    return handles


def _scale_folder(gui: viser.GuiApi, subject: Subject) -> dict[str, Any]:
    """Palette, range and isotherm; hidden if no modality has a unit."""
    scaled = subject.scaled or THERMAL
    unit, (low, high) = unit_of(scaled, subject.temperature), range_of(scaled, subject.temperature)
    step = 0.01 if unit == NORMALISED else 0.1
    ends = ("Coldest", "Hottest") if scaled == THERMAL else ("Lowest", "Highest")
    quantity = scaled.quantity
    with gui.add_folder(
        f"{quantity[:1].upper()}{quantity[1:]} scale", visible=bool(subject.scaled)
    ):
        return {
            "palette": gui.add_dropdown("Palette", PALETTE_CHOICES),
            "automatic": gui.add_checkbox(
                "Automatic",
                True,
                hint="The range follows the picture. Switch it off to set the range by hand.",
            ),
            "lowest": gui.add_number(f"{ends[0]}, {unit}", low, step=step),
            "highest": gui.add_number(f"{ends[1]}, {unit}", high, step=step),
            "marks_band": gui.add_checkbox(
                "Isotherm", False, hint="Marks all values from-to in one bright colour."
            ),
            "band_from": gui.add_number(
                f"From, {unit}", round(low + 0.6 * (high - low), 2), step=step
            ),
            "band_to": gui.add_number(f"To, {unit}", round(high, 2), step=step),
        }


def _measure_tab(gui: viser.GuiApi, inspection: Inspection) -> dict[str, Any]:
    can_read = bool(inspection.subject.readable)
    return {
        "keep_spot": gui.add_button(
            "Keep the point as a "
            "spot", icon="map-pin", hint="A spot stays on the object with the value that was read."
        ),
        "spots": gui.add_html(texts.spots(inspection)),
        "draw_box": gui.add_button(
            "Draw a box", icon="square", hint="Press, then drag over the picture. A box stays in "
                                              "the picture.",
            visible=can_read,
        ),
        "boxes": gui.add_html(
            texts.boxes((), None, inspection.subject), visible=can_read
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
        text = "The photos are not at hand: open the run with the scene's folder."
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

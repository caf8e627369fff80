"""What the report says of the settings that the temperatures were computed with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from mrgs.pictures.settings import Setting
from mrgs.report.texts import Texts


def emissivity_sentence(settings: Mapping[str, Setting], t: Texts) -> str:
    """Which emissivity the temperatures are for. They are apparent ones only where it is 1."""
    emissivity, reflected = settings["emissivity"], settings["reflected_c"]
    if emissivity.value == reflected.value == "":
        return t(
            "Emissivity: the scene's files do not record the emissivity and the reflected "
            "temperature that the temperatures were computed with; look them up in the camera or "
            "its original photos. Only surfaces with an emissivity of their own are corrected."
        )
    if emissivity.low == "1.00":
        return t(
            "Emissivity: the temperatures are apparent ones (emissivity {emissivity}); only "
            "surfaces with an emissivity of their own are corrected.",
            emissivity=_value(emissivity, t),
        )
    return t(
        "Emissivity: the temperatures were computed with emissivity {emissivity} and reflected "
        "temperature {reflected}; only surfaces with an emissivity of their own are corrected.",
        emissivity=_value(emissivity, t),
        reflected=_value(reflected, t),
    )


def air_sentence(settings: Mapping[str, Setting], t: Texts) -> str:
    """What was corrected for the air."""
    distance, air, humidity = (
        settings[name] for name in ("distance_m", "atmospheric_c", "humidity")
    )
    if distance.value == air.value == humidity.value == "":
        return t("Air: humidity, distance and wind are not corrected beyond what the camera did.")
    return t(
        "Air: the temperatures were computed with distance {distance}, air temperature {air} and "
        "relative humidity {humidity}. Wind is not corrected.",
        distance=_value(distance, t),
        air=_value(air, t),
        humidity=_value(humidity, t),
    )


def known_row(settings: Mapping[str, Setting], t: Texts) -> tuple[str, str]:
    """A row of the settings that are known."""
    known = _listed((each for each in settings.values() if each.value), t)
    return t("Settings of the temperatures"), known or t("not in the scene's files")


def given_rows(settings: Mapping[str, Setting], t: Texts) -> list[tuple[str, str]]:
    """A row of the settings that are the user's; none without any."""
    given = _listed((each for each in settings.values() if each.given), t)
    return [(t("Of these, given by the user"), given)] if given else []


def _listed(settings: Iterable[Setting], t: Texts) -> str:
    return "; ".join(f"{t(each.label)} {_range(each, t)}" for each in settings)


def _value(setting: Setting, t: Texts) -> str:
    """A setting and where it is from, for a sentence."""
    if not setting.value:
        unknown = t("not in the scene's files")
        return f"({unknown})"
    text = _range(setting, t)
    return t("{value} (given by the user)", value=text) if setting.given else text


def _range(setting: Setting, t: Texts) -> str:
    low, high = t.number(setting.low), t.number(setting.high)
    text = t("{low} to {high}", low=low, high=high) if setting.differs else low
    return text + setting.unit

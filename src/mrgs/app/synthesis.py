"""``mrgs synth``."""

from __future__ import annotations

from mrgs.app.commands import Synth
from mrgs.app.progress import counter
from mrgs.errors import ConfigError

MAX_SYNTH_SEED = 1_000_000
"""Mitsuba takes 32 bits, and every view has a seed of its own."""


def synth(command: Synth) -> None:
    """Generate a scene.

    Raises:
        ConfigError: there is no generator, or it cannot do what was asked for.
    """
    try:
        from mrgs_synth import synthesize
    except ModuleNotFoundError as error:
        if error.name != "mrgs_synth":
            raise
        raise ConfigError(
            "the scene generator comes with a source checkout only: run `pip install -e "
            "'.[synth]'` there"
        ) from None

    if not 0 <= command.seed <= MAX_SYNTH_SEED:
        raise ConfigError(f"the seed must be from 0 to {MAX_SYNTH_SEED:,}, not {command.seed}")
    if command.scene == "solar-plant":
        _synth_plant(command)
        return
    with counter("rendering") as progress:
        synthesize(
            command.output,
            scene=command.scene,
            width=command.width,
            height=command.height,
            train_views=40 if command.train_views is None else command.train_views,
            eval_views=command.eval_views,
            samples=command.samples,
            seed=command.seed,
            bands=["nir"] if command.nir else [],
            progress=progress,
        )
    print(f"scene: {command.output}")


def _synth_plant(command: Synth) -> None:
    from mrgs_synth.solar_plant import PlantOptions, synthesize_plant

    if command.nir or command.train_views is not None:
        raise ConfigError(
            "solar-plant has no near-infrared photos, and as many training views as its overlap "
            "asks for: leave out --nir and --train-views"
        )
    options = PlantOptions(
        command.rows, command.modules, command.overlap, command.gps_noise,
        command.eval_views, command.width, command.height, command.seed,
    )  # fmt: skip
    with counter("rendering") as progress:
        views = synthesize_plant(command.output, options, progress)
    print(f"scene: {command.output} ({views} training views)")

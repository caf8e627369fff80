"""The methods that can be trained, compared and opened, by name; imported at first use, so that the
command line can list them all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from mrgs.errors import ConfigError
from mrgs.system.wording import shown

PLUGINS = "mrgs.methods"
"""The entry points by which an installed package offers its ``Method`` objects."""

IN_CHECKOUT = ("thermonerf",)
"""Methods in packages of their own in the source checkout, ``plugins/NAME``."""


def imported(module: str, name: str) -> Callable[..., Any]:
    """A function of a module that is imported when the function is first called."""

    def call(*arguments: Any, **options: Any) -> Any:
        return getattr(import_module(module), name)(*arguments, **options)

    call.__name__ = call.__qualname__ = name
    call.__doc__ = f"``{module}.{name}``, imported when it is first called: see there."
    return call


@dataclass(frozen=True)
class Method:
    """A method: how a model of a scene is configured, trained and opened.

    A method that trains Gaussians with ``mrgs.train`` needs no more than the first three; give
    ``train`` a strategy or terms of its own with ``functools.partial``.

    Attributes:
        name: the value of ``--method``, and of ``method`` in a run's config.yaml.
        description: one line, for the help.
        make_config: configuration of a preset, from the keywords ``preset``, ``max_steps``,
            ``resolution``, ``seed``, and ``max_gaussians`` and ``batch`` where the method has
            Gaussians. A dataclass with what ``mrgs.run_files.folder.RunConfig`` asks for.
        train: trains or resumes a run, with the parameters of ``mrgs.train``; without ``on_model``
            where the method has no Gaussians.
        open: opens the newest checkpoint of a run as a ``TrainedRun``, from the folder, the scene
            (or None) and the device.
        read_config: configuration from YAML, the file's name, and the configuration with
            what the YAML leaves out (or None).
        has_gaussians: whether there is something to view and to export.
        uses_gpu: whether it can train and render on a GPU.
    """

    name: str
    description: str
    make_config: Callable[..., Any]
    train: Callable[..., Any] = field(default=imported("mrgs.training", "train"))
    open: Callable[..., Any] = field(default=imported("mrgs.runs.open", "open_gaussians"))
    read_config: Callable[..., Any] = field(default=imported("mrgs.training", "from_yaml"))
    has_gaussians: bool = True
    uses_gpu: bool = True

    def configure(
        self,
        preset: str = "default",
        *,
        max_steps: int | None = None,
        max_gaussians: int | None = None,
        resolution: int | None = None,
        seed: int = 0,
        batch: int = 1,
        changes: str = "",
        source: str = "",
    ) -> Any:
        """The configuration of a preset, with changed values; see ``mrgs.make_config`` for the
        others. ``max_gaussians`` and ``batch`` count where the method has Gaussians. ConfigError
        for a value that is not allowed, or changes for another method.

        ``changes`` are YAML of the values that differ, from a ``source`` for messages; they count
        before the others. A preset among them stands for all of its values; steps and batch rescale
        its schedule, as those given do."""
        options = {"preset": preset, "max_steps": max_steps, "batch": batch}
        if changes:  # some of them decide about others; errors are found when all of it is read
            from mrgs.system.strict_yaml import parse_yaml

            named = parse_yaml(changes, source)
            for name, kind in {"preset": str, "max_steps": int, "batch": int}.items():
                if isinstance(named, dict) and type(named.get(name)) is kind:
                    options[name] = named[name]
        if options["batch"] == 1:
            del options["batch"]
        if self.has_gaussians:
            options["max_gaussians"] = max_gaussians
        config = self.make_config(**options, resolution=resolution, seed=seed)
        config = replace(config, method=self.name)
        if not changes:
            return config
        changed = self.read_config(changes, source, config)
        if changed.method != self.name:
            other = shown(changed.method)
            raise ConfigError(f"{source} is for the method {other}, not {self.name}")
        return changed


_METHODS: dict[str, Method] = {}


def register(method: Method) -> None:
    """Make a method known by its name, in place of one of the same name."""
    _METHODS[method.name] = method


def find_method(name: str) -> Method:
    """The method of a name. ConfigError if there is none."""
    if name not in _METHODS:
        _register_plugins()
    if name not in _METHODS:
        if name in IN_CHECKOUT:
            raise ConfigError(
                f"the method {name} is in the package mrgs-{name}, which is not installed: run "
                f"`pip install ./plugins/{name}` in a checkout"
            )
        raise ConfigError(f"unknown method {shown(name)}; choose one of {', '.join(_METHODS)}")
    return _METHODS[name]


def registered_methods() -> tuple[Method, ...]:
    """All methods, those of other packages included, in the order of their registration."""
    _register_plugins()
    return tuple(_METHODS.values())


def _register_plugins() -> None:
    """Make the methods known that other packages offer as entry points."""
    for plugin in entry_points(group=PLUGINS):
        if plugin.name not in _METHODS:
            register(plugin.load())


for _name, _description in {
    "mrgs-plus": "two opacities, a model of the thermal camera, L_opaque and L_dist",
    "mrgs": "MrGS as published",
    "mrgs-base": "without heat transformation and L_boltz",
    "mrgs-fourier": "without L_boltz",
    "mrgs-boltz": "without heat transformation",
    "3dgs-rgbt": "3DGS with a temperature and one opacity",
}.items():
    register(Method(_name, _description, partial(imported("mrgs.training", "make_config"), _name)))

"""The shared Gaussians: one geometry; an opacity and an appearance of each modality."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.scene.modality import Modality, known_modalities


@dataclass(repr=False)
class Gaussians:
    """Parameters of N Gaussians (row i of every tensor belongs to Gaussian i).

    Attributes:
        means: centres μ in world coordinates, [N, 3].
        quats: rotations as quaternions wxyz, not necessarily normalised, [N, 4].
        log_scales: natural logarithm of the standard deviations along the rotated axes, [N, 3].
        opacity_logits: logit of each modality's opacity (o_c of RGB, o_t of thermal), [N, 1]. A
            modality that has none shares that of the first (3DGS_RGB-T blends both with o_c).
        sh_dc: spherical-harmonics coefficient of degree 0 of each modality of C channels,
            [N, 1, C]; of thermal that of the normalised temperature t_i.
        sh_rest: coefficients of the higher degrees, [N, 15, C]; [N, 0, C] for a modality that does
            not depend on the view, as t_i of MrGS as published.
        embedding: the multi-modal embedding e_m, [N, E]; E = 0 for 3DGS_RGB-T.
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    log_scales: Float[Tensor, "n 3"]
    opacity_logits: dict[Modality, Float[Tensor, "n 1"]]
    sh_dc: dict[Modality, Float[Tensor, "n 1 _"]]
    sh_rest: dict[Modality, Float[Tensor, "n _ _"]]
    embedding: Float[Tensor, "n e"]

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,}, {', '.join(map(str, self.modalities))})"

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that the Gaussians can be rendered in."""
        return tuple(self.sh_dc)

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the rotated axes, in scene units."""
        return self.log_scales.exp()

    def opacity(self, modality: Modality) -> Float[Tensor, " n"]:
        """o in (0, 1) of a modality: its own, or the first modality's if it shares that."""
        logits = self.opacity_logits
        own = logits[modality] if modality in logits else next(iter(logits.values()))
        return own[:, 0].sigmoid()

    def depends_on_view(self, modality: Modality) -> bool:
        """Whether a modality has harmonics above degree 0."""
        return self.sh_rest[modality].shape[1] > 0

    def to(self, device: torch.device) -> Gaussians:
        """Copies on a device, without gradients."""
        tensors = self.tensors().items()
        return self.with_tensors({name: each.detach().to(device) for name, each in tensors})

    def rows(self, rows: Int64[Tensor, " k"]) -> Gaussians:
        """Copies of some Gaussians, in this order, without gradients."""
        tensors = self.tensors().items()
        return self.with_tensors({name: each.detach()[rows] for name, each in tensors})

    def followed_by(self, others: Gaussians) -> Gaussians:
        """These Gaussians and then others of the same modalities, without gradients."""
        tensors, added = self.tensors().items(), others.tensors()
        return self.with_tensors(
            {name: torch.cat([each.detach(), added[name].detach()]) for name, each in tensors}
        )

    def tensors(self) -> dict[str, Tensor]:
        """The parameters by name (not copied): ``means``, ``quats``, ``log_scales``,
        ``opacity_logit.NAME``, ``sh_dc.NAME``, ``sh_rest.NAME`` of each modality, ``embedding``."""
        tensors = {"means": self.means, "quats": self.quats, "log_scales": self.log_scales}
        for group, by_modality in (
            ("opacity_logit", self.opacity_logits),
            ("sh_dc", self.sh_dc),
            ("sh_rest", self.sh_rest),
        ):
            tensors |= {f"{group}.{modality}": tensor for modality, tensor in by_modality.items()}
        return tensors | {"embedding": self.embedding}

    def replace(self, name: str, tensor: Tensor) -> None:
        """Put another tensor in the place of one of ``tensors``. KeyError for an unknown name."""
        if name not in self.tensors():
            raise KeyError(name)
        group, _, modality = name.partition(".")
        if not modality:
            setattr(self, name, tensor)
            return
        by_modality = self.opacity_logits if group == "opacity_logit" else getattr(self, group)
        by_modality[next(each for each in self.modalities if each.name == modality)] = tensor

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> Gaussians:
        """Gaussians of the same modalities, with other ``tensors``."""
        return Gaussians.from_tensors(tensors, self.modalities)

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], modalities: Iterable[Modality] | None = None
    ) -> Gaussians:
        """The Gaussians whose ``tensors`` these are.

        Args:
            modalities: those that the names speak of, and perhaps others, in the order that the
                Gaussians' are to have; None for all that are known.

        Raises:
            KeyError: a tensor that all Gaussians have is missing.
            ValueError: a modality that is not among ``modalities``.
        """
        by_name = {each.name: each for each in modalities or known_modalities()}

        def group(name: str) -> dict[Modality, Tensor]:
            prefix = f"{name}."
            names = {
                full.removeprefix(prefix): tensor
                for full, tensor in tensors.items()
                if full.startswith(prefix)
            }
            if unknown := names.keys() - by_name.keys():
                raise ValueError(f"unknown modalities: {', '.join(sorted(unknown))}")
            return {each: names[each.name] for each in by_name.values() if each.name in names}

        return cls(
            tensors["means"],
            tensors["quats"],
            tensors["log_scales"],
            group("opacity_logit"),
            group("sh_dc"),
            group("sh_rest"),
            tensors["embedding"],
        )

"""The warm and cold halos around the feet of objects: steady heat conduction in a plate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array, diags_array, eye_array, kron
from scipy.sparse.linalg import spsolve


@dataclass(frozen=True, eq=False)
class Plate:
    """A thin rectangular plate, centred on x = y = 0, that loses heat to the air of a room.

    Attributes:
        length_m: size along x.
        width_m: size along y.
        spread_m: √(conductivity · thickness / heat transfer coefficient), the distance over which a
            halo falls by 1/e from a straight edge.
        ambient_c: temperature of the air, °C.
        cell_m: spacing of the grid.
    """

    length_m: float
    width_m: float
    spread_m: float
    ambient_c: float
    cell_m: float = 0.004

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells along y and along x."""
        return round(self.width_m / self.cell_m), round(self.length_m / self.cell_m)

    def cell_centres(
        self,
    ) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
        """x and y of the centre of each cell, metres."""
        rows, columns = self.shape
        x = (np.arange(columns) + 0.5) * self.length_m / columns - self.length_m / 2
        y = (np.arange(rows) + 0.5) * self.width_m / rows - self.width_m / 2
        return tuple(np.meshgrid(x, y))  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class Contact:
    """Something hot or cold that touches a plate.

    Attributes:
        cells: where it touches, one flag per cell of the plate.
        temperature_c: its temperature, °C.
        coupling: contact conductance over the plate's heat transfer coefficient to the air; 100
            nearly imposes the temperature, 1 leaves the plate half-way between it and the air.
    """

    cells: Bool[np.ndarray, "rows columns"]
    temperature_c: float
    coupling: float


@dataclass(frozen=True, eq=False)
class PlateTemperature:
    """The solved temperature of a plate, °C per cell."""

    plate: Plate
    grid_c: Float[np.ndarray, "rows columns"]

    def at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Temperature below or above points given in the plate's frame, °C; bilinear between the
        cells."""
        rows, columns = self.plate.shape
        column = (points[:, 0] / self.plate.length_m + 0.5) * columns - 0.5
        row = (points[:, 1] / self.plate.width_m + 0.5) * rows - 0.5
        sampled: Float[np.ndarray, " n"] = map_coordinates(
            self.grid_c, [row, column], order=1, mode="nearest"
        )
        return sampled


def solve(plate: Plate, contacts: list[Contact]) -> PlateTemperature:
    """Solve the steady balance of conduction, loss to the air and contacts over a plate with
    insulated edges.

    With θ the excess over the air, λ the spread and c the coupling: λ²∇²θ − θ − c (θ − θ_contact) =
    0, the screened Poisson equation, by finite volumes.
    """
    rows, columns = plate.shape
    laplacian = kron(eye_array(rows), _second_difference(columns) / (plate.length_m / columns) ** 2)
    laplacian += kron(_second_difference(rows) / (plate.width_m / rows) ** 2, eye_array(columns))
    loss = np.ones(rows * columns)
    source = np.zeros(rows * columns)
    for contact in contacts:
        coupling = contact.coupling * contact.cells.ravel()
        loss += coupling
        source += coupling * (contact.temperature_c - plate.ambient_c)
    system = diags_array(loss) - plate.spread_m**2 * laplacian
    excess = spsolve(csr_array(system).tocsc(), source)
    return PlateTemperature(plate, plate.ambient_c + excess.reshape(rows, columns))


def _second_difference(n: int) -> csr_array:
    """[1, −2, 1] with no flow through the ends."""
    diagonal = np.full(n, -2.0)
    diagonal[[0, -1]] += 1.0
    neighbours = np.ones(n - 1)
    return csr_array(diags_array([neighbours, diagonal, neighbours], offsets=[-1, 0, 1]))

"""What a Gaussian looks like and how warm it is: encodings, the embedding's two heads, heat between
neighbours.

Equation numbers (Eq. 1 to 20) count the displayed equations of the MrGS paper's Method section in
their order; the word in brackets is the equation's label in the paper, or a short name where it has
none.
"""

from mrgs.field.field import FieldConfig, RadianceField
from mrgs.field.heat import nearest_neighbours

__all__ = ["FieldConfig", "RadianceField", "nearest_neighbours"]

"""Which of a folder's photos belong together."""

from mrgs.prepare.pairs.find import find_pairs

__all__ = ["find_pairs"]

"""The formats of figures, here by themselves so that the command line knows them before it imports what draws."""

from enum import Enum


class FigureFormat(str, Enum):
    """What figures are drawn in; its value is the suffix of their files."""

    PNG = "png"
    PDF = "pdf"
    SVG = "svg"


FORMATS = tuple(each.value for each in FigureFormat)
"""All of them, the first where nothing else is asked for."""

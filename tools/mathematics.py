"""The notebooks' LaTeX as MathML, which a browser draws without a script."""

from __future__ import annotations

import re

from latex2mathml import exceptions
from latex2mathml.converter import convert

REFUSALS: tuple[type[Exception], ...] = tuple(
    kind for kind in vars(exceptions).values() if isinstance(kind, type)
)

# latex2mathml knows neither `aligned` nor an argument without braces, and leaves out the thin space
# between a function's name and a letter; a matrix in a group of its own has fences of its height.
SOURCE = (
    (r"\\(begin|end)\{aligned\}", r"\\\1{align*}"),
    (r"\\(mathbf|boldsymbol)\s*(\\[a-zA-Z]+|[a-zA-Z])", r"\\\1{\2}"),
    (r"\\(arctan|sin|cos|tan)\s*(?=\\|[a-zA-Z])", r"\\\1\\,"),
    (r"\\begin\{([pb]matrix)\}", r"{\\begin{\1}"),
    (r"\\end\{([pb]matrix)\}", r"\\end{\1}}"),
)
# Browsers draw MathML Core, which has no <menclose>; the style sheet draws the box.
RESULT = (
    (r'<menclose notation="box">', '<mrow class="boxed">'),
    (r"</menclose>", "</mrow>"),
    (r'<mtable [^>]*columnspacing="0em 2em"[^>]*>', '<mtable class="aligned" displaystyle="true">'),
    (r"<mo>&#x0002F;</mo>", '<mo lspace="0" rspace="0">/</mo>'),
)
NOT_UNDERSTOOD = re.compile(r"\\[a-zA-Z]|<m[io]>(?:&|&amp;)</m[io]>|<merror")


def mathml(latex: str, display: bool = False) -> str:
    """A formula as a <math> element; ValueError for what would not come out as it was written."""
    for pattern, replacement in SOURCE:
        latex = re.sub(pattern, replacement, latex)
    try:
        result = convert(latex.strip(), display="block" if display else "inline")
    except REFUSALS as error:
        said = type(error).__name__
        raise ValueError(f"the formula {latex!r} cannot be drawn: {said}") from error
    for pattern, replacement in RESULT:
        result = re.sub(pattern, replacement, result)
    if found := NOT_UNDERSTOOD.search(result):
        raise ValueError(f"the formula {latex!r} cannot be drawn: {found.group()}")
    return result

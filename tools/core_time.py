"""Minutes that a notebook's core takes: `python -m tools.core_time` prints them by section.

A student reads 200 words a minute, what is printed, what is collapsed and what a checkpoint says to
the right answer as well, and takes 1.5 minutes for a checkpoint, 5 for an exercise and 1 for a
figure. What is marked deeper or comes after the core's end is not in.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from coursekit.lessons import checkpoint
from tools.build_notebooks import Cell, Notebook, find, joined, read

WORDS_A_MINUTE, CHECKPOINT, EXERCISE, FIGURE = 200, 1.5, 5.0, 1.0
MOST, MOST_OF_ALL = 25, 110
NOT_READ = re.compile(r"!\[.*?\]\(.*?\)|<style.*?</style>|<[^>]*>", re.DOTALL)
HEADING = re.compile(r"##? (.*)")
BEYOND = ("Deeper", "Studio", "Next", "Where this goes", "Keep what you have", "Onto the robot")


def core(notebook: Notebook) -> Iterator[tuple[str, Cell]]:
    """The cells of the core, each with its section's heading."""
    title, ended = "", False
    for cell in notebook["cells"]:
        heading = HEADING.match(joined(cell["source"])) if cell["cell_type"] == "markdown" else None
        if heading:
            ended = ended or title.startswith("The core ends here")
            title = heading[1]
        if not ended and not title.startswith(BEYOND):
            yield title, cell


def minutes(cell: Cell) -> float:
    """What one cell takes."""
    source = joined(cell["source"])
    if cell["cell_type"] == "markdown":
        return words(source) / WORDS_A_MINUTE
    if asked := re.findall(r'ck\.checkpoint\("([\w.]+)"', source):
        said = (checkpoint(name).explanation().lines for name in asked)
        return sum(CHECKPOINT + words(" ".join(lines)) / WORDS_A_MINUTE for lines in said)
    if exercises := source.count("ck.check("):
        return EXERCISE * exercises
    shown = [
        output.get("data", {"text/plain": output.get("text", "")}) for output in cell["outputs"]
    ]
    figures = any("image/png" in data for data in shown)
    texts = [joined(d.get("text/html") or d["text/plain"]) for d in shown if "image/png" not in d]
    read = sum(words(text) for text in texts if '<details class="alt">' not in text)
    return FIGURE * figures + read / WORDS_A_MINUTE


def words(text: str) -> int:
    """How many there are, less markup."""
    return len(re.findall(r"\S*\w\S*", NOT_READ.sub(" ", text)))


def core_minutes(notebook: Notebook) -> float:
    """What the core takes."""
    return sum(minutes(cell) for _, cell in core(notebook))


def main() -> None:
    """Print the minutes of every notebook, and of each section of its core."""
    for path in find([]):
        sections: dict[str, float] = {}
        for title, cell in core(read(path)):
            sections[title] = sections.get(title, 0.0) + minutes(cell)
        print(f"{path.stem}: {sum(sections.values()):.1f}")
        print(*(f"  {taken:5.1f}  {title}" for title, taken in sections.items()), sep="\n")


if __name__ == "__main__":
    main()

"""What the runtime takes on disk, package by package.

    python benchmarks/installed.py

Of the environment that runs this: the packages that taxeld asks for without extras, and those that
they ask for.
"""

from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

NONE_MB = 0.05  # less is not listed
Row = tuple[str, float, float | None]


def rows() -> list[Row]:
    """(figure, measured, budget): all, the largest first, and how many of them are torch."""
    sizes = {name: size_mb(name) for name in required("taxeld") - {"taxeld"}}
    largest = sorted(sizes, key=lambda name: -sizes[name])
    return [
        ("runtime packages: MB on disk", sum(sizes.values()), None),
        *((f"  … {name}: MB", sizes[name], None) for name in largest if sizes[name] > NONE_MB),
        ("torch among them", float("torch" in sizes), 0.0),
    ]


def required(name: str) -> set[str]:
    """The package, and all that it needs here."""
    found: set[str] = set()
    wanted = [name]
    while wanted:
        name = wanted.pop().lower()
        if name in found:
            continue
        found.add(name)
        for text in metadata.requires(name) or []:
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                wanted.append(requirement.name)
    return found


def size_mb(name: str) -> float:
    """The files that its wheel has installed."""
    paths = (Path(str(file.locate())) for file in metadata.files(name) or [])
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


if __name__ == "__main__":
    for figure, measured, _ in rows():
        print(f"{figure:40s} {measured:8.2f}")

"""What a simulated skin reads where recordings of real ones were measured, and their bands.

A fingertip presses a taxel for a second and leaves; then pressure rises and falls evenly on all of
them. Every skin has drawn its own taxels, and each taxel is pressed once.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld_hil.scenario.mesh_config import TYPICAL, MeshConfig
from taxeld_hil.scenario.scenario import Scenario, load
from taxeld_hil.world.electronics import Response
from taxeld_hil.world.foam import Foam
from taxeld_hil.world.mesh_physics import MeshPhysics
from taxeld_hil.world.mesh_skin import MeshSkin
from taxeld_hil.world.spread import drawn

SKINS, QUICK_SKINS = 150, 5
FULL_M, FULL_COUNTS = 0.005, 20_000.0
TIP_M = 0.008  # a fingertip's radius,
PRESS_M = 0.002  # how deep it presses,
PRESS_S = 1.0  # and for how long
RAMP = 4  # steps in, and out,
STEP_S = 0.05
REST_S = 60.0  # between presses
AWAY = np.array([1.0, 0.0, 0.0])
AFTER_S = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0)
RING = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
DENSE = "cylinder:rows=7,columns=63,radius_m=0.04,pitch_m=0.004"  # 4 mm apart, to see the sag
APART_M = np.arange(0.004, 0.0241, 0.004)
LEVELS = np.linspace(0.0, 1.0, 101)  # of pressure,
LOOP_FROM = 0.2  # from which on a loop is looked at


Say = Callable[[str], None]


class Band(NamedTuple):
    """What recordings say of one figure, in percent where it is a share; `at`: a time or place."""

    name: str
    at: float
    quantile: str  # median, p90, mean, rms or sd
    low: float
    high: float


# measured on public recordings
BANDS = (
    *(Band("residue", t, "median", 1.2, 2.5) for t in (0.1, 0.2, 0.3, 0.5)),
    Band("residue", 2.0, "median", 0.6, 1.5),
    Band("residue", 4.0, "median", 0.4, 1.0),
    *(Band("residue", t, "p90", 3.0, 9.0) for t in (0.1, 0.2, 0.3, 0.5)),
    Band("residue", 5.0, "p90", 5.0, 6.0),
    Band("sag", 0.012, "median", 0.0, 1.0),
    Band("sag", 0.012, "p90", 5.0, 40.0),
    Band("hysteresis", 0.0, "median", 0.0, 1.5),
    Band("hysteresis", 0.0, "p90", 0.0, 3.2),
    Band("cross-talk", 0.0, "median", 0.5, 1.5),
    Band("cross-talk", 0.0, "mean", 2.0, 4.0),
    Band("own gain leaves", 0.0, "rms", 5.0, 7.0),
    Band("a common gain leaves", 0.0, "rms", 8.0, 13.0),
    Band("gain", 0.0, "sd", 13.0, 19.0),
    Band("noise", 0.0, "median", 13.0, 45.0),
    Band("noise", 0.0, "p90", 13.0, 45.0),
    Band("idle", 0.0, "median", 10_247.0 - 286.0, 10_247.0 + 286.0),
)


@dataclass(frozen=True)
class Ball:
    """A fingertip, whose middle is at the height of the middle row."""

    radius_m: float
    centre = np.zeros(2)

    @property
    def size(self) -> float:
        return self.radius_m

    def distance(self, points: Floats) -> Floats:
        return np.asarray(np.linalg.norm(points, axis=0) - self.radius_m)


class Curves(NamedTuple):
    """Of S skins; readings as shares of the press's peak, or of full scale."""

    residue: Floats  # (S·P, times): of P presses of each skin
    sag: Floats  # (S·P, distances)
    cross_talk: Floats  # (S·P·k,)
    up: Floats  # (S·M, levels) while pressure rises, in shares of a taxel's full
    down: Floats  # (S·M, levels) while it falls, in the order of rising pressure
    gain: Floats  # (S·M,)
    noise_counts: Floats  # (S·M,)
    idle_counts: Floats  # (S·M,)


def experiment(names: tuple[str, ...], skins: int, out: Path, say: Say) -> Iterator[Path]:
    """`skins` of each name, as `curves.json` and `curves.png` in the directory `out`.

    Raises:
        SetupError: there is no such skin; or, with the JSON written, nothing to draw with.
    """
    if skins < 1:
        raise SetupError("--seeds must be at least 1")
    base = load("demo")
    found = {}
    for name in names:
        found[name] = measured(base.on(name), skins)
        say(f"{name}: {skins} skins")
    out.mkdir(parents=True, exist_ok=True)
    path = out / "curves.json"
    rows = [
        {"skin": name, **{k: _short(v) for k, v in row.items()}}
        for name, each in found.items()
        for row in figures(each)
    ]
    text = ",\n  ".join(json.dumps(row) for row in rows)
    of = {name: {k: _short(v) for k, v in asdict(base.on(name).skin).items()} for name in names}
    path.write_text(
        f'{{\n "skins": {json.dumps(of)},\n "figures": [\n  {text}\n ]\n}}\n', encoding="utf-8"
    )
    yield path
    try:
        from taxeld_hil.experiment import curves_chart  # noqa: PLC0415  # the picture alone needs it
    except ImportError:
        cure = "pip install 'taxeld[view]'"
        raise SetupError(f"curves.png: drawing needs matplotlib; {cure}") from None
    curves_chart.draw(found, out / "curves.png")
    yield out / "curves.png"


def lines(path: Path) -> Iterator[str]:
    """Such a JSON file's figures as a Markdown table, a column a skin."""
    rows = json.loads(path.read_text(encoding="utf-8"))["figures"]
    names = list(dict.fromkeys(row["skin"] for row in rows))
    yield "| measured on public recordings | band | " + " | ".join(names) + " |"
    yield "|---" * (len(names) + 2) + "|"
    for band in BANDS:
        same = [row for row in rows if (row["name"], row["at"], row["quantile"])
                == (band.name, band.at, band.quantile)]  # fmt: skip
        cells = [f"{row['measured']:.5g}" for row in same]
        yield f"| {_title(band)} | {band.low:g} … {band.high:g} | " + " | ".join(cells) + " |"


def _title(band: Band) -> str:
    where = {"residue": f", {band.at:g} s after", "sag": f", {1e3 * band.at:g} mm away"}
    unit = {"noise": "counts", "idle": "counts"}.get(band.name, "%")
    return f"{band.name}{where.get(band.name, '')}, {band.quantile} [{unit}]"


def _short(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def measured(scenario: Scenario, skins: int, seed: int = 0) -> Curves:
    """The skin of a scenario, `skins` times."""
    rng = np.random.default_rng(seed)
    config = scenario.skin
    quiet = replace(config, cross_talk=(0.0, 0.0))
    alone = replace(config, sag_m=(0.0, 0.0))
    rows: list[tuple[Floats, ...]] = []
    for own in rng.spawn(skins):
        up, down = _even(config, own)
        taxels = len(up)
        rows.append((
            _residue(quiet, own),
            _sag(quiet, own),
            _cross_talk(alone, own),
            up,
            down,
            np.maximum(1.0 + config.gain_cv * own.standard_normal(taxels), 0.1),
            drawn(config.noise_counts, own.standard_normal(taxels)),
            scenario.baseline_counts + scenario.baseline_spread * own.standard_normal(taxels),
        ))  # fmt: skip
    return Curves(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def figures(curves: Curves) -> list[dict[str, Any]]:
    """What the recordings have a band for: measured beside it."""
    return [
        {**band._asdict(), "measured": (value := _figure(curves, band)),
         "inside": band.low <= value <= band.high}
        for band in BANDS
    ]  # fmt: skip


def widest(curves: Curves) -> Floats:
    """(S·M,) of each taxel's loop, as a share of its full; over what stays of the press."""
    return np.asarray((curves.down - curves.up)[:, LEVELS >= LOOP_FROM].max(axis=1))


def left(curves: Curves, *, own_gain: bool) -> float:
    """What the common curve leaves of all readings: rms, as a share of full."""
    mean = 0.5 * (curves.up + curves.down)
    read = mean * curves.gain[:, None]
    common = read.mean(axis=0)
    gain = read @ common / (common @ common)
    if not own_gain:
        gain = np.full(len(read), gain.mean())
    return float(np.sqrt(np.mean((read / gain[:, None] - common) ** 2)) / common[-1])


def _figure(curves: Curves, band: Band) -> float:
    if band.name == "own gain leaves":
        return 100.0 * left(curves, own_gain=True)
    if band.name == "a common gain leaves":
        return 100.0 * left(curves, own_gain=False)
    values, unit = {
        "residue": (curves.residue[:, int(np.searchsorted(AFTER_S, band.at))], 100.0),
        "sag": (curves.sag[:, int(np.abs(APART_M - band.at).argmin())], 100.0),
        "hysteresis": (widest(curves), 100.0),
        "cross-talk": (curves.cross_talk, 100.0),
        "gain": (curves.gain, 100.0),
        "noise": (curves.noise_counts, 1.0),
        "idle": (curves.idle_counts, 1.0),
    }[band.name]
    of = {
        "median": np.median(values),
        "p90": np.quantile(values, 0.9),
        "mean": np.mean(values),
        "sd": np.std(values),
    }
    return unit * float(of[band.quantile])


def _even(config: MeshConfig, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """(M, levels) of a patch under even pressure, up and down."""
    taxels = len(layouts.load(RING))
    response, foam = Response(config, taxels, rng), Foam(config, taxels, rng)
    way = np.concatenate([LEVELS, LEVELS[::-1]])
    read = np.array([
        foam.press(response(np.full(taxels, h)), STEP_S * k) for k, h in enumerate(way)
    ]).T  # fmt: skip
    return read[:, : len(LEVELS)], read[:, : len(LEVELS) - 1 : -1]


def _residue(config: MeshConfig, rng: np.random.Generator) -> Floats:
    """(presses, times) of the taxels of the middle row, one after the other."""
    patch = _patch(RING)
    physics = _physics(config, patch, rng)
    ramp = [PRESS_M * k / RAMP for k in range(1, RAMP + 1)]
    steps = [(depth, STEP_S) for depth in ramp]  # from the one before
    rows, now = [], 0.0
    for taxel in patch.middle:
        for depth, step_s in [*steps, (PRESS_M, PRESS_S), *steps[-2::-1]]:
            now += step_s
            counts = physics.press(patch.pressed(taxel, depth), now)[taxel]
            if depth == PRESS_M:
                peak = counts
        now += STEP_S
        left = [physics.press(AWAY, now + t)[taxel] for t in (0.0, *AFTER_S)]
        rows.append(np.array(left[1:]) / peak)
        now += REST_S
    return np.array(rows)


def _sag(config: MeshConfig, rng: np.random.Generator) -> Floats:
    """(presses, distances) beside a taxel, along its row."""
    patch, far = _patch(DENSE), len(APART_M)
    physics = _physics(config, patch, rng)
    rows = []
    for k, at in enumerate(range(far, len(patch.middle) - far, 5)):
        row = patch.middle[at : at + 1 + far]
        counts = physics.press(patch.pressed(row[0], PRESS_M), REST_S * k)[row]
        physics.press(AWAY, REST_S * (k + 0.5))
        rows.append(counts[1:] / counts[0])
    return np.array(rows)


def _cross_talk(config: MeshConfig, rng: np.random.Generator) -> Floats:
    """(n,) of the others of the module of a taxel that is pressed."""
    patch = _patch(RING)
    physics, module = _physics(config, patch, rng), patch.layout.uid >> 4
    shares = []
    for k, taxel in enumerate(patch.middle):
        counts = physics.press(patch.pressed(taxel, PRESS_M), REST_S * k)
        physics.press(AWAY, REST_S * (k + 0.5))
        others = (module == module[taxel]) & (np.arange(len(module)) != taxel)
        shares.append(counts[others] / counts[taxel])
    return np.concatenate(shares)


class _Patch:
    """A layout under a fingertip."""

    def __init__(self, name: str) -> None:
        self.layout = layouts.load(name)
        self.skin = MeshSkin(Ball(TIP_M), self.layout, TYPICAL.taxel_radius_m)
        level = np.abs(self.layout.position_m[:, 2]) < 1e-9
        self.middle: list[int] = np.flatnonzero(level).tolist()

    def pressed(self, taxel: int, depth_m: float) -> Poses:
        """The pose (3,) of a fingertip that presses this taxel of the middle row so deep."""
        place = self.layout.position_m[taxel, :2]
        apart = 1.0 + (TIP_M - depth_m) / np.hypot(*place)
        return np.array([*(apart * place), 0.0])


@lru_cache
def _patch(name: str) -> _Patch:
    return _Patch(name)


def _physics(config: MeshConfig, patch: _Patch, rng: np.random.Generator) -> MeshPhysics:
    full = np.full(len(patch.layout), FULL_COUNTS)
    return MeshPhysics(config, patch.skin, patch.layout, FULL_M, full, rng)

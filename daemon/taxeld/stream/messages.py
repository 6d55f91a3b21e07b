"""What is published: one msgpack map a message, every key always present (docs/stream.md).

PlotJuggler's ZMQ subscriber plots the estimate stream as it is: string keys, and only numbers,
booleans, lists and maps.
"""

from collections.abc import Mapping, Sequence
from enum import IntEnum
from types import MappingProxyType
from typing import Any

from taxeld import __version__
from taxeld.arrays import Floats, Poses
from taxeld.estimator.estimate import Estimate, ProposalKind, Status
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.observation import Activation
from taxeld.model.scene import Scene
from taxeld.pipeline.freshness import CURES, Why
from taxeld.proposals.samples import Degraded
from taxeld.skin.patches import Patches, in_world
from taxeld.stream import values

OTHER = "other"  # in `objects`: none of the known ones
VERSION = 3  # version of the stream: `v` in every message

STAGES = ("source", "skin", "propose", "filter", "publish", "total")


def estimate(
    e: Estimate,
    *,
    names: Sequence[str],
    seq: int,
    why: Why,
    mono_ns: int = 0,
    age_us: float = 0.0,
    overruns: int = 0,
    degraded: int = 0,
    lat_us: dict[str, float] | None = None,
    links: Sequence[Why] = (Why.VALID,),
) -> dict[str, Any]:
    """`/taxeld/estimate`; `names` are of the objects that it may be, `links` tells of each link why
    its scans are of no use. In a replay, where time is not
    measured, the timing keys are 0."""
    return {
        **_head(seq, e.t),
        "mono_ns": mono_ns,
        "valid": why is Why.VALID,
        "why": int(why),
        "status": int(e.status),
        "p": e.p,
        "radius_m": e.radius_m,
        "hypotheses": e.hypotheses._asdict(),
        "object": e.object,
        "objects": _named(e.objects, names),
        "contact": e.contact,
        "contacts": e.contacts,
        "map": _pose(e.map),
        "mean": _pose(e.mean),
        "cov": e.cov.tolist(),
        "modes": [
            {**_pose(mode.pose), "weight": mode.weight, "object": mode.object} for mode in e.modes
        ],
        "ess": e.ess,
        "particles": e.particles,
        "injected": e.injected,
        "proposal": int(e.proposal),
        "log_evidence": e.log_evidence,
        "age_us": age_us,
        "overruns": overruns,
        "degraded": degraded,
        "lat_us": lat_us or dict.fromkeys(STAGES, 0.0),
        **({"links": [int(each) for each in links]} if len(links) > 1 else {}),
    }


def _head(seq: int, t: float, link: int = 0) -> dict[str, Any]:
    """The keys of every message; the number of the first link is left out."""
    return {"v": VERSION, "seq": seq, "t": t, **({"link": link} if link else {})}


def _named(objects: Sequence[float], names: Sequence[str]) -> dict[str, float]:
    """Probabilities of objects by their names, and that of none of them."""
    return {**dict(zip(names, objects, strict=True)), OTHER: max(1.0 - sum(objects), 0.0)}


def particles(t: float, seq: int, pose: Poses, weight: Poses) -> dict[str, Any]:
    """`/taxeld/particles`: particles' poses (N, 3) in m, m, rad, and weights (N,)."""
    return _head(seq, t) | {"xytheta": pose.tolist(), "weight": weight.tolist()}


def taxels(activation: Activation, sensor: Poses | None, seq: int, link: int = 0) -> dict[str, Any]:
    """`/taxeld/taxels` of a link; `sensor` (3,) is None where it is not known."""
    return {
        **_head(seq, activation.t, link),
        "z": activation.z.tolist(),
        "live": activation.live.tolist(),
        "placed": sensor is not None,
        "sensor": _pose(se2.IDENTITY if sensor is None else sensor),
    }


def contacts(
    t: float, patches: Patches, sensor: Poses | None, seq: int, link: int = 0
) -> dict[str, Any]:
    """`/taxeld/contacts` of a link: the patches of touch of its last scan, at Unix time t."""
    at = se2.IDENTITY if sensor is None else sensor
    return {
        **_head(seq, t, link),
        "placed": sensor is not None,
        "left_out": patches.left_out,
        "patches": [
            {
                "id": one.id,
                "taxels": len(one.taxels),
                "area_m2": one.area_m2,
                "sum": one.sum,
                "peak": one.peak,
                "depth_m": one.depth_m,
                "position": _vector(one.position_m),
                "normal": _vector(one.normal),
                "world_position": _vector(in_world(at, one.position_m, is_place=True)),
                "world_normal": _vector(in_world(at, one.normal, is_place=False)),
            }
            for one in patches.now
        ],
    }


def counts(t: float, counts: Floats, seq: int, link: int = 0) -> dict[str, Any]:
    """`/taxeld/counts` of a link: its last readings (M,), 0 where none is valid."""
    came = (counts > 0.0).tolist()
    return _head(seq, t, link) | {"counts": counts.tolist(), "came": came}


def health(seq: int, t: float, counted: dict[str, Any]) -> dict[str, Any]:
    """`/taxeld/health`: what the table of values has of all that is counted, by part."""
    return _head(seq, t) | values.published(counted)


def info(
    layout: Layout,
    scenes: Mapping[str, Scene],
    config_hash: str,
    links: Mapping[str, Layout] = MappingProxyType({}),
) -> dict[str, Any]:
    """`/taxeld/info`: which daemon this is, and what its numbers mean; `scenes` by the names of the
    objects, in the order of their numbers, `links` by their names, where there are several."""
    objects = [
        {
            "name": name,
            "symmetry": scene.symmetry,
            "outlines": [one.tolist() for one in scene.outlines],
        }
        for name, scene in scenes.items()
    ]
    first, *_ = [*objects, {"name": "", "symmetry": 0, "outlines": []}]
    return {
        "v": VERSION,
        "taxeld": __version__,
        "units": {"length": "m", "angle": "rad", "time": "s", "lat_us": "us", "age_us": "us"},
        "status": {str(int(s)): s.name.lower() for s in Status},
        "why": {str(int(w)): w.name.lower() for w in Why},
        "proposal": {str(int(p)): p.name.lower() for p in ProposalKind},
        "degraded": {str(int(s)): s.name.lower() for s in Degraded},
        "layout": _layout(layout),
        "object": first["name"],
        "symmetry": first["symmetry"],
        "outlines": first["outlines"],
        "objects": objects,
        "config_hash": config_hash,
    } | ({"links": [{"name": k, "layout": _layout(v)} for k, v in links.items()]} if links else {})


def _layout(layout: Layout) -> dict[str, Any]:
    return {
        "name": layout.name,
        "digest": layout.digest,
        "taxels": len(layout),
        "radius_m": layout.radius_m,
        "position_m": layout.position_m.tolist(),
    }


def object_of(e: Mapping[str, Any]) -> str:
    """The name of the object that an estimate's map is of, with its probability where it might be
    another one; empty in the map of an older daemon."""
    likely = list(e.get("objects", {}).items())
    if len(likely) < 2:  # `other` alone
        return ""
    name, p = likely[e["object"]]
    return f"{name} {p:.1%}" if len(likely) > 2 else str(name)


def name_of(kind: type[IntEnum], number: int) -> str:
    """The name of a status or proposal; a newer daemon may send one that is not known here."""
    return {int(one): one.name.lower() for one in kind}.get(number, f"unknown ({number})")


def reason_of(number: int) -> str:
    """Why an estimate is not valid, and the cure, by the number in its map."""
    return {int(why): cure for why, cure in CURES.items()}.get(number, name_of(Why, number))


def _vector(v: Floats) -> dict[str, float]:
    return {"x": float(v[0]), "y": float(v[1]), "z": float(v[2])}


def _pose(pose: Poses) -> dict[str, float]:
    return {"x": float(pose[0]), "y": float(pose[1]), "theta": float(pose[2])}

"""`taxeld advise`: a client that learns what a daemon has felt, and ranks approaches by it."""

import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.advice.candidates import Candidate
from taxeld.commands.advise import read
from taxeld.proposals.bundle import Bundle
from taxeld.stream import client
from tests.rig.commands import printed, refused
from tests.rig.memories import remembered

from .. import pages
from .test_pipeline import CAN, CONFIG, ROBOT, pipeline_of, story, taken

Asked = tuple[str, Path, str, Path]
HEAD = "x,y,theta,x1,y1"
PAGE = Path(__file__).parents[2] / "docs" / "advice.md"


@pytest.fixture
def answer(box: Bundle, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Of a daemon that has felt the box in one touch."""
    pipeline, packed = pipeline_of(box, ROBOT), io.BytesIO()
    taken(pipeline, story(box, 5.0))
    np.savez(packed, allow_pickle=False, **remembered(pipeline.estimator))
    given = {"ok": True, "memory": packed.getvalue()}
    monkeypatch.setattr(client, "ask", lambda *_: given)
    return given


@pytest.fixture
def asked(tmp_path: Path) -> Asked:
    """With the daemon's configuration, and the page's candidates."""
    config = tmp_path / "can0.toml"
    config.write_text(f"[source]\n{CAN}\n{CONFIG}{ROBOT}", encoding="utf-8")
    with pages.working_in(tmp_path):
        pages.run(pages.blocks(PAGE)[0].code, {})
    return "advise", config, "--candidates", tmp_path / "ring.csv"


@pytest.mark.usefixtures("answer")
def test_candidates_are_ranked_by_what_the_daemon_has_felt_as_the_page_shows(asked: Asked) -> None:
    said, as_json = printed(*asked), printed(*asked, "--json")
    assert as_json == printed(*asked, "--json")
    told = [json.loads(line) for line in as_json.splitlines()]
    assert [f"{each['nats']:.2f}" for each in told] == re.findall(r"^\d\S*", said, re.MULTILINE)
    assert told[0]["nats"] > told[-1]["nats"]
    shown = dict(pages.FENCED.findall(PAGE.read_text("utf-8")))["console"].partition("\n")[2]
    assert pages.NUMBER.sub("N", shown).split() == pages.NUMBER.sub("N", said).split(), said


def test_where_there_is_no_advice_it_says_why(answer: dict[str, Any], asked: Asked) -> None:
    text = asked[1].read_text("utf-8")
    for was, other, says in (
        (CONFIG, "", "scene.bundle: is empty"),
        ('"manifold"', '"manifold"\nseed = 7', "the daemon has another scene"),
        ('"manifold"', '"manifold"\ninjection = "paper"', "the daemon has another scene"),
    ):
        asked[1].write_text(text.replace(was, other), encoding="utf-8")
        assert refused(*asked).startswith(says)
    answer |= {"ok": False, "error": "nothing was felt yet"}
    assert "nothing was felt yet" in refused(*asked, status=1)


def test_candidates_are_of_the_link_that_a_column_names(tmp_path: Path) -> None:
    table = tmp_path / "ways.csv"
    table.write_text(f"{HEAD},link\n0.1,0.2,-1,0.3,0.4,right\n", encoding="utf-8")
    assert read(table, ["left", "right"]) == [Candidate(0.1, 0.2, -1.0, 0.3, 0.4, 1)]


@pytest.mark.usefixtures("answer")
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"", ": unreadable (no lines of UTF-8 text); name a CSV file of x,y,theta,x1,y1"),
        (b"\xff\xfe", ": unreadable (no lines of UTF-8 text); name a CSV file of x,y,theta,x1,y1"),
        (b"x,y\n1,2\n", ": must be the line x,y,theta,x1,y1 and one for each approach"),
        (HEAD.encode(), ": must be the line x,y,theta,x1,y1 and one for each approach"),
        (b"0,0,0,1,0\n0,0,0,1\n", ":3: must be x,y,theta,x1,y1, not '0,0,0,1'"),
        (b"0,0,0,1,0,left\n", ":2: must be x,y,theta,x1,y1, not '0,0,0,1,0,left'"),
        (b"0,a,0,1,0\n", ":2: must be x,y,theta,x1,y1, not '0,a,0,1,0'"),
        (b"0,nan,0,1,0\n", ":2: must be metres and radians, 10 at most"),
        (b"0,0,90,1,0\n", ":2: must be metres and radians, 10 at most"),
        (b"1,1,0,1,1\n", ":2: must end elsewhere than it begins"),
        (b"0,0,0,1,0\n" * 1001, "candidates: must be at most 1000, not 1001"),
    ],
)
def test_a_table_that_is_none_is_refused_in_a_line_with_its_place(
    asked: Asked, text: bytes, says: str
) -> None:
    asked[3].write_bytes(text if text[:1] in b"x\xff" else f"{HEAD}\n".encode() + text)
    assert refused(*asked) == (f"{asked[3]}{says}\n" if says.startswith(":") else f"{says}\n")

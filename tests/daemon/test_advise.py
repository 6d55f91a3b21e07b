"""`taxeld advise`: what a running daemon advises, for a person or a program."""

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.commands import check
from taxeld.config.file import parse
from taxeld.stream import messages
from taxeld.view import advise
from tests.rig.commands import printed, refused

from .conftest import Sockets
from .test_loop import settings
from .test_stream_document import documented

_, INFO = documented("/taxeld/info")
_, ADVICE = documented("/taxeld/advice")
LATER = ADVICE | {"contacts": 4, "enough": True, "approaches": []}
Speak = Callable[..., str]


@pytest.fixture
def speak(sockets: Sockets, tmp_path: Path) -> Iterator[Speak]:
    """Has a daemon send maps, one after the other, again and again; → where."""
    publisher: zmq.Socket[Any] = sockets.open(zmq.XPUB)
    endpoint, ended, speakers = f"ipc://{tmp_path}/stream", threading.Event(), []
    publisher.bind(endpoint)

    def send(advice: tuple[dict[str, Any], ...]) -> None:
        said = [(messages.INFO, INFO), *((messages.ADVICE, one) for one in advice)]
        while not ended.wait(0.005):
            for topic, body in said:
                publisher.send_multipart([topic, msgpack.packb(body), b"0.0"])

    def begin(*advice: dict[str, Any]) -> str:
        speakers.append(threading.Thread(target=send, args=[advice]))
        speakers[0].start()
        return endpoint

    yield begin
    ended.set()
    for speaker in speakers:
        speaker.join()


def test_it_tells_the_best_approaches_in_the_robots_words(speak: Speak) -> None:
    said = printed("advise", "--endpoint", speak(ADVICE)).splitlines()
    assert said == [
        "after 3 contacts, best first:",
        "1. from x 0.3100 m, y -0.0500 m, yaw 3.100 rad",
        "   along 180°, until x 0.0600 m, y -0.0500 m at most",
        "   contact expected at x 0.2200 m, y -0.0500 m; then press 3.0 mm",
        "   touches 97%, sure afterwards 62%, gain 4.1 mm",
    ]


def test_in_the_end_it_says_that_no_touch_would_tell_more(speak: Speak) -> None:
    said = printed("advise", "--endpoint", speak(LATER))
    assert said == "after 4 contacts: no touch would tell more\n"


def test_a_program_gets_the_message_itself(speak: Speak) -> None:
    assert json.loads(printed("advise", "--json", "--endpoint", speak(ADVICE))) == ADVICE


def test_each_new_advice_is_told_once_until_it_is_stopped(
    speak: Speak, capsys: pytest.CaptureFixture[str]
) -> None:
    heard = list[str]()

    def stopping() -> bool:
        heard.extend(capsys.readouterr().out.splitlines())
        return len(heard) >= 4

    endpoint = speak(ADVICE, ADVICE, LATER)
    assert advise.advise(endpoint, None, stopping, as_json=True, follow=True)
    told = [json.loads(line)["contacts"] for line in heard]
    assert told[:4] in ([3, 4, 3, 4], [4, 3, 4, 3]), "each change"


def test_where_none_comes_it_says_what_may_be_wrong(
    speak: Speak, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(advise, "ANSWER_S", 0.5)
    said = refused("advise", "--endpoint", f"ipc://{tmp_path}/nobody", status=1)
    assert "no daemon answers" in said
    said = refused("advise", "--endpoint", speak(), status=1)
    assert "no advice comes: set advice.enabled in its configuration" in said
    config = tmp_path / "can0.toml"
    config.write_text(settings(tmp_path), encoding="utf-8")
    assert refused("advise", config).startswith("advice.enabled: is false")


def test_check_notes_that_a_sensor_at_rest_follows_nothing(tmp_path: Path) -> None:
    text = settings(tmp_path) + "[advice]\nenabled = true\n"
    assert check.notes(parse(text)) == [check.STILL]
    robot = '[sensor_pose]\nendpoint = "ipc:///robot"\n'
    assert check.notes(parse(text + robot)) == []

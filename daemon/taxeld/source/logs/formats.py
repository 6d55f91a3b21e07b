"""The text formats of CAN logs: candump's, Vector's asc, PEAK's trc, and python-can's csv.

python-can reads most of them as well, but more slowly, and up to the first damaged line.
"""

import base64
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from itertools import accumulate

from taxeld.source.logs.text import Format, Readable, blocks, compiled

DIFFERENCE_MAX_S = 1e6  # what is larger is no time since another frame
EPOCH_OF_TRC = datetime(1899, 12, 30, tzinfo=UTC)

_HEX = "[0-9A-Fa-f]"
_END = r"[ \t]*\r?$"
_EMPTY = rf"^(){_END}"


def told(file: Readable) -> Format | None:
    """The format of a text log, by the first block in which a frame stands; None: none does."""
    head = ""
    for number, lines in blocks(file):
        if number == 1:
            head = lines
        forms = [_with_times(LOG, lines), _with_times(SCREEN, lines), *_asc(head), *_trc(head), CSV]
        frames = [len(form.frames.findall(lines)) for form in forms]
        if any(frames):
            return forms[frames.index(max(frames))]
    return None


def _hexadecimal(text: str) -> tuple[int, bool]:
    return int(text, 16), len(text) > 4


def _counted(text: str) -> bytes:
    """`2 43 1A`: a length of one digit, a character, and as many bytes."""
    return _of_length(bytes.fromhex(text[2:]), int(text[0], 16))


def _of_length(data: bytes, length: int) -> bytes:
    if len(data) != min(length, 8):  # a length up to 15 means 8
        raise ValueError("the length is not that of the data")
    return data


# candump writes "(t) can0 101#431A" into files, and "  (t)  can0  101   [2]  43 1A" on the screen.
# With -t A a time is a date, with -t d a difference; -x adds RX or TX, -8 a raw length in braces or
# behind an underscore, -a the data as text. The id of an error frame has one of its highest bits.
_ID = f"{_HEX}{{3}}|[01]{_HEX}{{7}}"
_STAMP = r"\((\d{1,12}\.\d{1,9}|\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{1,9})\)[ \t]+"
_LOG = rf"^[ \t]*(?:{_STAMP}(\S{{1,40}})[ \t]+)?"
_SCREEN = rf"^[ \t]*(?:{_STAMP})?(\S{{1,40}})[ \t]+(?:[RT]X [-BS] [-ER][ \t]+)?"
LOG = Format(
    compiled(rf"{_LOG}({_ID})#({_HEX}{{0,16}})(?:_[9A-F])?(?:[ \t]+[RT])?{_END}"),
    compiled(
        rf"{_LOG}(?:(?:{_ID})#(?:[Rr][0-8]?(?:_[9A-F])?|#\S+)|[2-9A-Fa-f]{_HEX}{{7}}#\S*"
        rf"|{_HEX}{{5}}#\S+)(?:[ \t]+[RT])?{_END}"
    ),
    compiled(_EMPTY),
    _hexadecimal,
    bytes.fromhex,
)
SCREEN = Format(
    compiled(
        rf"{_SCREEN}({_ID})[ \t]+[\[{{]({_HEX}[\]}}](?:[ \t]+{_HEX}{{2}}){{0,8}})"
        rf"(?:[ \t]+'.*)?{_END}"
    ),
    compiled(
        rf"{_SCREEN}{_HEX}{{3,8}}[ \t]+"
        r"(?:[\[{].[\]}].*(?:remote request|ERRORFRAME)|\[\d\d\]|\[\d{4}\] \()"
    ),
    compiled(rf"{_EMPTY}|^\t"),  # lines that explain an error frame
    _hexadecimal,
    _counted,
)


def _with_times(form: Format, lines: str) -> Format:
    """A format of candump's, with the kind of times that these lines have."""
    stamps = [groups[0] for groups in form.frames.findall(lines) if groups[0]]
    if stamps and "-" in stamps[0]:
        return replace(form, seconds=_date)
    numbers = [float(stamp) for stamp in stamps if "-" not in stamp]
    return replace(form, differences=are_differences(numbers))


def are_differences(stamps: list[float]) -> bool:
    """Whether the stamps of a log's first lines are each the time since the line before.

    candump writes those (`-t d`) as it writes times since the first line (`-t z`). But times grow:
    most of the later half are larger than all of the first, and none falls back by much, whereas
    differences fall back, or begin with 0 and go on with the same.
    """
    if len(stamps) < 2 or max(stamps) > DIFFERENCE_MAX_S:
        return False
    half = len(stamps) // 2
    later = sorted(stamps[half:])
    fallen = max(peak - t for peak, t in zip(accumulate(stamps, max), stamps, strict=True))
    grow = later[len(later) // 2] > max(stamps[:half]) and fallen <= max(stamps) / 2.0
    return not grow and (fallen > 0.0 or stamps[0] == 0.0 < stamps[1])


def _date(text: str) -> float:
    """Unix time of a date and a time of day where this machine is."""
    return _day_and_second(text[:19]) + float("0" + text[19:])


@lru_cache(maxsize=4)  # a second has thousands of frames
def _day_and_second(text: str) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except (OverflowError, OSError) as error:
        raise ValueError(f"{text} is no date") from error


# Vector's asc: "0.001000 1  101  Rx  d 2 43 1A", in the base that the header names, "x" behind an
# extended id. Events of many kinds stand between the frames.
_ASC_TIME = r"\d{1,12}\.\d{1,9}"
_ASC_FRAME = r"\d{1,3}[ \t]+\S+[ \t]+[RT]x\b"
ASC = Format(
    compiled(
        rf"^[ \t]*({_ASC_TIME})[ \t]+(\d{{1,3}})[ \t]+({_HEX}{{1,10}}[xX]?)[ \t]+[RT]x[ \t]+d[ \t]+"
        rf"({_HEX}(?:[ \t]+{_HEX}{{1,3}}){{0,8}})(?:[ \t]+Length[ \t]*=.*)?{_END}"
    ),
    compiled(
        rf"^[ \t]*({_ASC_TIME})[ \t]+(?=(\d{{1,3}})[ \t]|CANFD\b)"
        rf"(?:{_ASC_FRAME}[ \t]+r\b|\d+[ \t]+ErrorFrame|CANFD\b)"
    ),
    compiled(rf"^[ \t]*(?![ \t])(?!\d+\.\d+[ \t]+{_ASC_FRAME})(?:({_ASC_TIME})[ \t])?"),
    lambda text: (int(text.rstrip("xX"), 16), text[-1] in "xX"),
    _counted,
)


def _asc(head: str) -> list[Format]:
    """The format that a header tells, of a file whose first lines may be one."""
    header = re.search(
        r"^[ \t]*base[ \t]+(hex|dec)(?:[ \t]+timestamps[ \t]+(absolute|relative))?",
        head, re.IGNORECASE | re.MULTILINE,
    )  # fmt: skip
    form = replace(ASC, differences=header is not None and str(header[2]).lower() == "relative")
    if header is None or header[1].lower() == "hex":
        return [form]
    return [
        replace(
            form,
            can_id=lambda text: (int(text.rstrip("xX")), text[-1] in "xX"),
            data=_decimal,
        )
    ]


def _decimal(text: str) -> bytes:
    length, *data = map(int, text.split())
    return _of_length(bytes(data), length)


# PEAK's trc: "1)  1059.9  Rx  0101  2  43 1A", in columns that its version has or its header names
_TRC_VERSIONS = {"1.0": "NOILD", "1.1": "NOdILD", "1.2": "NOBdILD", "1.3": "NOBdIRLD"}
_TRC_COLUMNS = {
    "N": r"^[ \t]*\d+\)?[ \t]+",
    "O": r"(\d{1,15}(?:\.\d{1,9})?)[ \t]+",
    "T": r"DT[ \t]+",
    "B": r"(\d{1,2})[ \t]+",
    "d": r"[RT]x[ \t]+",
    "I": rf"({_HEX}{{4,8}})[ \t]+",
    "R": r"-[ \t]+",
    "L": rf"({_HEX}",
    "D": rf"(?:[ \t]+{_HEX}{{2}}){{0,8}}){_END}",
}
_TRC_ORDER = re.compile("NOT?B?d?Id?R?LD")
_TRC_AT = _TRC_COLUMNS["N"] + _TRC_COLUMNS["O"] + r"(?:\d{1,2}[ \t]+)?"


def _trc(head: str) -> list[Format]:
    """The format that a header tells; none where it is no trc file, or of columns not known."""
    if not head.startswith(";"):
        return []
    named = dict(re.findall(r"^;\$(\w+)=(\S+)", head, re.MULTILINE))
    columns = named.get("COLUMNS", "").replace(",", "").replace("l", "L")
    columns = columns or _TRC_VERSIONS.get(named.get("FILEVERSION", "1.0"), "")
    if not _TRC_ORDER.fullmatch(columns):
        return []
    pattern = "".join(_TRC_COLUMNS[column] for column in columns)
    if "B" not in columns:
        pattern = pattern.replace(_TRC_COLUMNS["O"], _TRC_COLUMNS["O"] + "()")
    return [
        Format(
            compiled(pattern),
            compiled(rf"{_TRC_AT}()(?:(?:RR|ER|FD|FB|FE|BI|Error)\b|.*\bRTR\b)"),
            compiled(rf"{_EMPTY}|^;|{_TRC_AT}(?:Warng|ST|EC|EV|FFFFFFFF)\b"),
            _hexadecimal,
            _counted,
            units_per_s=1000.0,
            start_s=_trc_start(named.get("STARTTIME", "")),
        )
    ]


def _trc_start(days: str) -> float:
    """Unix time of the days since the epoch of spreadsheets; 0 where a file has none."""
    try:
        return (EPOCH_OF_TRC + timedelta(days=float(days))).timestamp()
    except (ValueError, OverflowError):
        return 0.0


# python-can's csv: "1700000000.5,0x101,0,0,0,2,Qxo=": extended, remote, error, length, data
_CSV_AT = r"^(\d{1,12}(?:\.\d{1,20})?(?:e-\d\d)?),()"


def _base64(text: str) -> bytes:
    return _of_length(base64.b64decode(text[2:], validate=True), int(text[0]))


CSV = Format(
    compiled(rf"{_CSV_AT}(0x{_HEX}{{1,8}},[01]),0,0,([0-8],[A-Za-z0-9+/]{{0,11}}={{0,2}}){_END}"),
    compiled(rf"{_CSV_AT}0x{_HEX}{{1,8}},[01],(?:1,0|0,1|0,0,\d\d),"),
    compiled(rf"{_EMPTY}|^timestamp,arbitration_id,extended,remote,error,dlc,data"),
    lambda text: (int(text[:-2], 16), text[-1] == "1"),
    _base64,
)

"""What a calibration leaves behind: its file, and beside it a text and a picture."""

from pathlib import Path

from taxeld.commands.calibration_result import Result
from taxeld.commands.calibration_text import lines
from taxeld.commands.hearing import Say
from taxeld.errors import SetupError
from taxeld.service import calibration_file


def write(result: Result, out: Path, say: Say) -> None:
    """The file, and beside it a text and a picture. Raises SetupError."""
    layout = result.heard.model.layout
    text, picture = out.with_suffix(".txt"), out.with_suffix(".png")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(calibration_file.dump(result.calibration, layout), encoding="utf-8")
        text.write_text("\n".join([*lines(result), ""]), encoding="utf-8")
        try:
            from taxeld.commands.calibration_draw import draw  # noqa: PLC0415  (extra `view`)
        except ImportError as error:
            say(f"no picture: {error}; pip install 'taxeld[view]'")
            return
        draw(result, picture)
    except OSError as error:
        raise SetupError(
            f"--out: cannot write {error.filename or out} ({error.strerror})"
        ) from None

"""The houses' imports point one way: protocol ← daemon ← training, hil; torch in training alone."""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = {
    "firmware_protocol/taxeld_protocol": {"taxeld_protocol"},
    "daemon/taxeld": {"taxeld_protocol", "taxeld"},
    "training/taxeld_training": {"taxeld_protocol", "taxeld", "taxeld_training", "torch"},
    "hil/taxeld_hil": {"taxeld_protocol", "taxeld", "taxeld_hil"},
}
GUARDED = {"taxeld_protocol", "taxeld", "taxeld_training", "taxeld_hil", "torch"}


def wrong_imports(root: Path = ROOT) -> list[str]:
    """One line an import that points the wrong way."""
    wrong = []
    for folder, allowed in PACKAGES.items():
        for path in sorted((root / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                for name in _imported(node):
                    top = name.split(".")[0]
                    if top in GUARDED - allowed:
                        wrong.append(f"{path.relative_to(root)}:{node.lineno}: imports {top}")  # type: ignore[attr-defined]
    return wrong


def _imported(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom) and node.module and not node.level:
        return [node.module]
    return []


if __name__ == "__main__":
    found = wrong_imports()
    print("\n".join(found))  # noqa: T201
    sys.exit(bool(found))

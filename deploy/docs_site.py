"""The site's pages from outside `docs`: the README as the first page, the changelog, and the
examples that pages link to. Pages are written for the repository; links are turned here."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PAGES = {"README.md": "index.md", "CHANGELOG.md": "CHANGELOG.md"}
FILES = [
    str(path.relative_to(ROOT))
    for path in sorted(ROOT.glob("examples/**/*"))
    if path.suffix in (".py", ".toml", ".json")
]
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)(#[^)]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for source, name in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=text))
    for source in FILES:
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, source, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Links as seen from the site; of what is in the repository alone, the link's text."""
    is_outside = page.file.src_uri in PAGES.values()
    here = ROOT if is_outside else (ROOT / "docs" / page.file.src_uri).parent

    def turned(link: re.Match[str]) -> str:
        image, text, target, anchor = link[1], link[2], link[3], link[4] or ""
        if "://" in target or "/" in page.file.src_uri:  # pages of a folder link within `docs`
            return link[0]
        name = target.removeprefix("docs/") if is_outside else target.removeprefix("../")
        name = PAGES.get(name, name)
        if (here / target).exists() and files.get_file_from_path(name) is None:
            return text
        return f"{image}[{text}]({name}{anchor})"

    return LINK.sub(turned, markdown)

"""Show what has its home elsewhere in the repository: the README's results, and pictures.

mkdocs runs this as a hook. ``<!-- readme:results -->`` on a page becomes the table between the
markers of README.md, and a picture under ``results/`` that a page shows is copied into the site.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import Abort
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
PLACE = "<!-- readme:results -->"
START, END = "<!-- results:start -->", "<!-- results:end -->"
_PICTURE = re.compile(r"\]\((?:\.\./)+(results/[\w./-]+\.(?:gif|png))\)")


def on_files(files: Any, *, config: Any) -> Any:
    """Take along the pictures that pages show."""
    pages = [file.content_string for file in files.documentation_pages()]
    for name in sorted({name for page in pages for name in _PICTURE.findall(page)}):
        if not (ROOT / name).is_file():
            raise Abort(f"a page shows {name}, which there is not")
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Put in the table, and the pictures' places in the site."""
    if PLACE in markdown:
        readme = (ROOT / "README.md").read_text()
        table = readme.split(START)[1].split(END)[0].strip()
        markdown = markdown.replace(PLACE, table)
    up = "../" * page.file.src_uri.count("/")
    return _PICTURE.sub(rf"]({up}\1)", markdown)

"""A page of HTML that stands alone, from Markdown with tables and images."""

import base64
import html
from pathlib import Path

from markdown_it import MarkdownIt

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1c1c1c; background: #fff;
  max-width: 60rem; margin: 2rem auto; padding: 0 1rem }
h1, h2, h3 { line-height: 1.2; margin-top: 2.2rem }
h1 { margin-top: 0 }
table { border-collapse: collapse; margin: 1rem 0; display: block; overflow-x: auto;
  font-size: .88rem; font-variant-numeric: tabular-nums }
th, td { border-bottom: 1px solid #ddd; padding: .35rem .6rem; text-align: left;
  vertical-align: top }
th { border-bottom: 2px solid #888 }
img { max-width: 100%; height: auto }
code { font-size: .85em; overflow-wrap: anywhere }
pre { background: #f5f5f5; padding: .7rem; overflow-x: auto }
"""


def page(markdown: str, folder: Path) -> str:
    """Render Markdown; images are read from below the folder and become part of the page."""
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(markdown)
    title = "Reproduction"
    for number, token in enumerate(tokens):
        if token.type == "heading_open" and token.tag == "h1":
            title = tokens[number + 1].content
        for child in token.children or ():
            if child.type == "image":
                child.attrSet("src", _embedded(folder / str(child.attrGet("src"))))
                child.attrSet("loading", "lazy")
    body = parser.renderer.render(tokens, parser.options, {})
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n{body}</body>\n</html>\n"
    )


def _embedded(image: Path) -> str:
    """An image's bytes as an address."""
    return f"data:image/png;base64,{base64.b64encode(image.read_bytes()).decode()}"

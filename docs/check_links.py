"""Every link of the built site leads somewhere, offline: python docs/check_links.py docs/_build/html"""

import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """What a page links to, and the anchors that it has."""

    def __init__(self, text):
        super().__init__()
        self.anchors, self.links = set(), []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        """Collect what names a place or a target."""
        for name, value in attrs:
            if value and (name == "id" or (tag == "a" and name == "name")):
                self.anchors.add(value)
            if value and name in ("href", "src"):
                self.links.append(value)


@cache
def page(path):
    """A page of the site, read once."""
    return Page(path.read_text(encoding="utf-8"))


def fault(source, link):
    """What is wrong with a link of a page; empty where it leads somewhere, or well-formed to elsewhere."""
    parts = urlsplit(link)
    if parts.scheme in ("http", "https"):
        return "" if parts.netloc and not set(link) & set(" <>{}") else "no address"
    if parts.scheme or parts.netloc:
        return "" if parts.scheme in ("mailto", "data") else "not http"
    target = (source.parent / unquote(parts.path)).resolve() if parts.path else source
    target = target / "index.html" if target.is_dir() else target
    if not target.is_file():
        return "no such file"
    if parts.fragment and target.suffix == ".html" and unquote(parts.fragment) not in page(target).anchors:
        return "no such anchor"
    return ""


def faults(folder):
    """Faults of all pages below a folder, but of the theme's templates."""
    root = Path(folder).resolve()
    pages = [path for path in sorted(root.rglob("*.html")) if "_static" not in path.parts]
    if not pages:
        return [f"{folder} has no pages"]
    return [
        f"{path.relative_to(root)}: {link}: {said}"
        for path in pages
        for link in dict.fromkeys(page(path).links)
        if (said := fault(path, link))
    ]


if __name__ == "__main__":
    found = faults(sys.argv[1])
    sys.exit("\n".join(found) if found else 0)

"""The start page at the site's root too, where browsers and servers look for it."""

from pathlib import Path

from sphinx.application import Sphinx


def copy_start_page(app: Sphinx, exception: Exception | None) -> None:
    """Copies it as `index.html`, with links that are relative to where it comes from."""
    if exception is None and app.builder.name == "html":
        page = f"{app.config.root_doc}.html"
        text = Path(app.outdir, page).read_text()
        Path(app.outdir, "index.html").write_text(
            text.replace("<head>", f'<head><base href="{page}">', 1)
        )


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("build-finished", copy_start_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

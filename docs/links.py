"""Links of notebooks, on the site.

On GitHub a notebook lies beside `docs/`, on the site within it: `../docs/theory/` there is
`../theory/` here. mkdocs calls `on_page_markdown` with the text of every page.
"""


def on_page_markdown(markdown, *, page, **_):
    """The text of a page; of a notebook with its links as the site needs them."""
    if page.file.src_uri.startswith("notebooks/"):
        return markdown.replace("](../docs/", "](../")
    return markdown

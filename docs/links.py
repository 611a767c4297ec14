"""Links of notebooks and of results, on the site.

On GitHub notebooks and results lie beside `docs/`, on the site within it: `../docs/theory/` of a
notebook is `../theory/` here, and `../../docs/theory/` of a result too. mkdocs calls
`on_page_markdown` with the text of every page.
"""


def on_page_markdown(markdown, *, page, **_):
    """The text of a page; of a notebook or a result with its links as the site needs them."""
    if page.file.src_uri.startswith("notebooks/"):
        return markdown.replace("](../docs/", "](../")
    if page.file.src_uri.startswith("measured/"):
        return markdown.replace("](../../docs/", "](../")
    return markdown

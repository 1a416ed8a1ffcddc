"""What a page says: its text, tags, addresses and table cells; elements must be closed in order."""

from html.parser import HTMLParser

VOID = ("meta", "br", "link", "img")


class HtmlPage(HTMLParser):
    """A page that was read; `open` has the elements that nothing closed."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.cells: list[list[str]] = []  # class, text
        self.text = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the element."""
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "action")]
        if tag not in VOID:
            self.open.append(tag)
        if tag in ("td", "th"):
            self.cells.append([dict(attrs).get("class") or "", ""])

    def handle_endtag(self, tag: str) -> None:
        """Only the latest open element may end."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Note the text that a reader sees."""
        if self.open[-1:] not in (["script"], ["style"]):
            self.text += data
        if self.open[-1:] in (["td"], ["th"]):
            self.cells[-1][1] += data

"""What a page says and consists of, as an HTML parser sees it."""

from html.parser import HTMLParser

VOID = {"meta", "link", "br", "img", "input", "hr"}
INVISIBLE = {"style", "script", "title"}


IMAGE, SCRIPT = "<img src=x onerror=alert(1)>", "</title><script>alert(1)</script>"
"""Names that must be shown as they are."""


class Parsed(HTMLParser):
    """A page: its tags with their attributes and its words; an element that is not closed in its place fails."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.words, self.open, self.headings = [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag in ("h1", "h2", "h3", "h4"):
            self.headings.append((int(tag[1]), ""))

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open, tag
        assert self.open[-1] == tag, (self.open, tag)
        self.open.pop()

    def handle_data(self, data):
        if self.open and self.open[-1] in ("h1", "h2", "h3", "h4"):
            self.headings[-1] = (self.headings[-1][0], self.headings[-1][1] + data)
        if not set(self.open) & INVISIBLE:
            self.words.append(data)

    @property
    def text(self):
        """All visible words, spaces made one."""
        return " ".join(" ".join(self.words).split())

    def all(self, tag):
        """Return the attributes of all elements of a kind."""
        return [attrs for name, attrs in self.tags if name == tag]

    @property
    def foreign_scripts(self):
        """Attributes of the scripts that are neither data nor the one at the end of the page."""
        return [tag for tag in self.all("script")[:-1] if tag != {"type": "application/octet-stream"}]

    def values(self, attribute):
        """Return all values of an attribute."""
        return [attrs[attribute] for _, attrs in self.tags if attribute in attrs]

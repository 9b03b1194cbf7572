"""Creator, owner and rights written into the tags of image files."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from xml.sax.saxutils import escape


@dataclass(frozen=True)
class Credits:
    """Facts of one object for the headers of its files; what is unknown is empty, `date` is of the capture, ISO 8601, never from the clock."""

    title: str = ""
    creator: str = ""
    date: str = ""
    rights: str = ""
    description: str = ""

    @property
    def moment(self) -> datetime | None:
        """The date as TIFF's DateTime takes it: to the second, without time zone."""
        try:
            return datetime.fromisoformat(self.date).replace(microsecond=0, tzinfo=None)
        except ValueError:
            return None

    def to_xmp(self) -> bytes:
        """Return an XMP packet in Dublin Core, UTF-8; empty where nothing is known.

        >>> b"<dc:rights>" in Credits(rights="CC BY 4.0").to_xmp()
        True
        """
        language = '<rdf:Alt><rdf:li xml:lang="x-default">{}</rdf:li></rdf:Alt>'
        sequence = "<rdf:Seq><rdf:li>{}</rdf:li></rdf:Seq>"
        forms = {"title": language, "creator": sequence, "date": sequence}
        facts = "".join(
            f"<dc:{name}>{form.format(_xml(getattr(self, name)))}</dc:{name}>"
            for name, form in {**forms, "rights": language, "description": language}.items()
            if getattr(self, name)
        )
        if not facts:
            return b""
        return (
            '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
            '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
            '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            '<rdf:Description rdf:about="" xmlns:dc="http://purl.org/dc/elements/1.1/">'
            f"{facts}</rdf:Description></rdf:RDF></x:xmpmeta>"
            '<?xpacket end="r"?>'
        ).encode("utf-8", "replace")


def _xml(text: str) -> str:
    # XML 1.0 has no word for control characters, not even escaped.
    return escape("".join(c for c in text if c >= " " or c in "\t\n\r"))

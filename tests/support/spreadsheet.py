"""An .xlsx with the cells that a test needs, as Excel writes them."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
OF_OFFICE = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
OF_PACKAGE = "http://schemas.openxmlformats.org/package/2006"
WORKBOOK = "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml"
STYLES = (
    '<numFmts count="1"><numFmt numFmtId="164" formatCode="yyyy\\-mm\\-dd hh:mm:ss.000"/></numFmts>'
    '<cellXfs count="2"><xf numFmtId="0"/><xf numFmtId="164" applyNumberFormat="1"/></cellXfs>'
)


class Date(float):
    """Days since 1900, shown as a date."""


class Formula(float):
    """Value of a formula."""


class Fault(str):
    """Value of a formula that failed: #DIV/0!."""


def write_xlsx(path: Path, sheets: Mapping[str, Sequence[Sequence[float | str | None]]], *, last: str = "") -> None:
    """Write sheets by their names; `last` is one more cell that somebody left on each."""
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{OF_PACKAGE}/content-types"><Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="xml" ContentType="application/xml"/>'
        f'<Override PartName="/xl/workbook.xml" ContentType="{WORKBOOK}"/></Types>',
        "_rels/.rels": _relationships([("w", "officeDocument", "xl/workbook.xml")]),
        "xl/workbook.xml": f'<workbook xmlns="{MAIN}" xmlns:r="{OF_OFFICE}"><sheets>'
        + "".join(f'<sheet name="{escape(name)}" sheetId="{k}" r:id="s{k}"/>' for k, name in enumerate(sheets, 1))
        + "</sheets></workbook>",
        "xl/_rels/workbook.xml.rels": _relationships(
            [("styles", "styles", "styles.xml")]
            + [(f"s{k}", "worksheet", f"worksheets/sheet{k}.xml") for k in range(1, len(sheets) + 1)]
        ),
        "xl/styles.xml": f'<styleSheet xmlns="{MAIN}">{STYLES}</styleSheet>',
    }
    extra = f'<row><c r="{last}"><v>1</v></c></row>' if last else ""
    for k, rows in enumerate(sheets.values(), 1):
        cells = (
            f'<row r="{r}">{"".join(_cell(f"{chr(64 + c)}{r}", value) for c, value in enumerate(row, 1))}</row>'
            for r, row in enumerate(rows, 1)
        )
        parts[f"xl/worksheets/sheet{k}.xml"] = (
            f'<worksheet xmlns="{MAIN}"><sheetData>{"".join(cells)}{extra}</sheetData></worksheet>'
        )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in parts.items():
            archive.writestr(name, f'<?xml version="1.0" encoding="UTF-8"?>{text}')


def _relationships(each: Sequence[tuple[str, str, str]]) -> str:
    listed = "".join(f'<Relationship Id="{key}" Type="{OF_OFFICE}/{kind}" Target="{target}"/>' for key, kind, target in each)
    return f'<Relationships xmlns="{OF_PACKAGE}/relationships">{listed}</Relationships>'


def _cell(place: str, value: float | str | None) -> str:
    match value:
        case None:
            return ""
        case Fault():
            return f'<c r="{place}" t="e"><f>1/0</f><v>{value}</v></c>'
        case str():
            return f'<c r="{place}" t="inlineStr"><is><t>{escape(value)}</t></is></c>'
        case Date():
            return f'<c r="{place}" s="1"><v>{float(value)!r}</v></c>'
        case Formula():
            return f'<c r="{place}"><f>A1*2</f><v>{float(value)!r}</v></c>'
        case _:
            return f'<c r="{place}"><v>{float(value)!r}</v></c>'

"""Requirements as other tools and spreadsheets write them."""

import contextlib
import zipfile

import pytest

from verifai_jax.addons.monitoring.requirement_files import read_requirements, write_requirements
from verifai_jax.mtl import parse

HEAD = (
    '<?xml version="1.0" encoding="UTF-8"?><r:REQ-IF '
    'xmlns:r="http://www.omg.org/spec/ReqIF/20110401/reqif.xsd" '
    'xmlns:reqif-xhtml="http://www.w3.org/1999/xhtml"><r:CORE-CONTENT><r:REQ-IF-CONTENT>'
)
TAIL = "</r:REQ-IF-CONTENT></r:CORE-CONTENT></r:REQ-IF>"
KINDS = {"text": "XHTML", "formula": "XHTML", "id": "STRING", "severity": "ENUMERATION"}


def value(name, content, kind=""):
    kind = kind or KINDS[name]
    body = {
        "XHTML": f"<r:THE-VALUE>{content}</r:THE-VALUE>",
        "ENUMERATION": f"<r:VALUES><r:ENUM-VALUE-REF>{content}</r:ENUM-VALUE-REF></r:VALUES>",
    }.get(kind, "")
    plain = "" if body else f' THE-VALUE="{content}"'
    reference = f"r:ATTRIBUTE-DEFINITION-{kind}-REF"
    return (
        f"<r:ATTRIBUTE-VALUE-{kind}{plain}><r:DEFINITION><{reference}>{name}</{reference}>"
        f"</r:DEFINITION>{body}</r:ATTRIBUTE-VALUE-{kind}>"
    )


def document(objects, names=(), defaults=(), lines=()):
    """Write objects, a dictionary each, with prefixes of namespaces as most tools do."""
    named = {"text": "ReqIF.Text", "id": "ReqIF.ForeignID"} | dict(names)
    text = HEAD + "<r:DATATYPES><r:DATATYPE-DEFINITION-ENUMERATION><r:SPECIFIED-VALUES>"
    text += '<r:ENUM-VALUE IDENTIFIER="e1" LONG-NAME="ASIL B"/><r:ENUM-VALUE IDENTIFIER="e2"/>'
    text += "</r:SPECIFIED-VALUES></r:DATATYPE-DEFINITION-ENUMERATION></r:DATATYPES>"
    text += '<r:SPEC-TYPES><r:SPEC-OBJECT-TYPE IDENTIFIER="t"><r:SPEC-ATTRIBUTES>'
    for name in {**KINDS, **named}:
        kind = KINDS.get(name, "STRING")
        text += f'<r:ATTRIBUTE-DEFINITION-{kind} IDENTIFIER="{name}" '
        text += f'LONG-NAME="{named.get(name, name)}">'
        if name in dict(defaults):
            text += f"<r:DEFAULT-VALUE>{value(name, dict(defaults)[name])}</r:DEFAULT-VALUE>"
        text += f"</r:ATTRIBUTE-DEFINITION-{kind}>"
    text += "</r:SPEC-ATTRIBUTES></r:SPEC-OBJECT-TYPE></r:SPEC-TYPES><r:SPEC-OBJECTS>"
    for number, given in enumerate(objects):
        values = "".join(value(n, c, KINDS.get(n, "STRING")) for n, c in given.items())
        text += f'<r:SPEC-OBJECT IDENTIFIER="o{number}"><r:TYPE><r:SPEC-OBJECT-TYPE-REF>t'
        text += f"</r:SPEC-OBJECT-TYPE-REF></r:TYPE><r:VALUES>{values}</r:VALUES></r:SPEC-OBJECT>"
    text += "</r:SPEC-OBJECTS><r:SPECIFICATIONS>"
    for line in lines:
        text += f"<r:SPECIFICATION><r:CHILDREN>{line}</r:CHILDREN></r:SPECIFICATION>"
    return f"{text}</r:SPECIFICATIONS>{TAIL}"


def xhtml(markup):
    """Write markup with the prefix of DOORS on each element."""
    return "".join(
        f"</reqif-xhtml:{part[1:]}" if part.startswith("/") else f"<reqif-xhtml:{part}"
        for part in markup.split("<")[1:]
    )


def read_one(tmp_path, given, **options):
    path = tmp_path / "tool.reqif"
    path.write_text(document([given], **options), encoding="utf-8")
    (found,) = read_requirements(path, need_formulas=False)
    return found


@pytest.mark.parametrize(
    ("markup", "text"),
    [
        ("<div>above 30<br/>for 5 s</div>", "above 30 for 5 s"),
        ("<div><p>above 30</p><p>for 5 s</p></div>", "above 30 for 5 s"),
        ("<div>one of<ul><li>a</li><li>b</li></ul>c</div>", "one of a b c"),
        ("<div><table><tr><td>30</td><td>50</td></tr><tr><td>7</td></tr></table></div>", "30 50 7"),
        ("<div>30<object data='a.png'>picture</object>50</div>", "30 picture 50"),
        ("<div>i<b>n</b>li<span>n</span>e, <i>k</i>m</div>", "inline, km"),
        ("<div>9.81 m/s<sup>2</sup>, 10<sup>-3</sup></div>", "9.81 m/s^2, 10^-3"),
        ("<div>at most <del>30</del>50</div>", "at most 50"),
        ("<div>a\u00a0b\u202fc &#160;d h&#173;y\u200bphen</div>", "a b c d hyphen"),
        ("<div>1 &lt; 2 &amp; 3</div>", "1 < 2 & 3"),
        ("<div>plain</div>", "plain"),
    ],
)  # fmt: skip
def test_formatted_texts(tmp_path, markup, text):
    assert read_one(tmp_path, {"text": xhtml(markup)}).text == text


def test_formulas_of_word_processors(tmp_path):
    markup = "<div>(always<br/>x ≤ 3)<br/>∧<br/>always y ≥ −1\u00a0</div>"
    found = read_one(tmp_path, {"id": "R", "formula": xhtml(markup)})
    assert found.formula == parse("(always x <= 3) & always y >= -1")
    assert parse("x² < 2·y ∧ ¬(x ≠ 1) → □ y > 0") == parse("x**2 < 2*y & !(x != 1) -> always y > 0")
    assert parse('"x ≤ y" < 1').signals() == ("x ≤ y",)


def test_defaults_and_choices_and_names(tmp_path):
    defaults = {"severity": "e1", "text": xhtml("<div>default</div>")}
    found = read_one(tmp_path, {"id": "A"}, defaults=defaults)
    assert (found.severity, found.text) == ("ASIL B", "default")
    found = read_one(tmp_path, {"id": "A", "severity": "e2", "text": ""}, defaults=defaults)
    assert (found.severity, found.text) == ("e2", "")
    names = {"text": "Object Text", "own": "id", "more": "ReqIF.Description"}
    given = {"own": "other", "id": "7", "more": "less", "text": xhtml("<div>it</div>")}
    assert read_one(tmp_path, given, names={"own": "id"} | {"more": "Comment"}).id == "7"
    assert read_one(tmp_path, given, names=names).id == "7"
    names = {"text": "Name", "id": "Key"}
    with pytest.raises(
        ValueError, match=r"of its attributes, .*'key', .*'name', .* an object must"
    ):
        read_one(tmp_path, {"id": "7"}, names=names)


def test_links_with_spaces(tmp_path):
    path = tmp_path / "some.toml"
    path.write_text(
        "[[requirement]]\nid = 'A'\nlinks = ['ISO 1 7.4', 'B']\n"
        "[[requirement]]\nid = 'B'\nlinks = 'C, D E'"
    )
    first, second = read_requirements(path, need_formulas=False)
    assert (first.links, second.links) == (("ISO 1 7.4", "B"), ("C", "D", "E"))
    for ending in ("csv", "reqif"):
        written = write_requirements([first, second], tmp_path / f"some.{ending}")
        assert read_requirements(written, need_formulas=False) == (first, second)


def test_order_deleted_and_archives(tmp_path):
    def line(number, inner=""):
        return (
            f"<r:SPEC-HIERARCHY><r:OBJECT><r:SPEC-OBJECT-REF>o{number}</r:SPEC-OBJECT-REF>"
            f"</r:OBJECT><r:CHILDREN>{inner}</r:CHILDREN></r:SPEC-HIERARCHY>"
        )

    objects = [{"id": "A"}, {"id": "B"}, {"id": "C", "gone": "true"}, {"id": "D"}]
    text = document(
        objects, names={"gone": "ReqIF.ForeignDeleted"}, lines=[line(3, line(1)), line(3) + line(2)]
    )
    path = tmp_path / "both.reqifz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("inner/some.reqif", text)
        archive.writestr("inner/picture.png", b"1")
    found = read_requirements(path, need_formulas=False)
    assert [each.id for each in found] == ["D", "B", "A"]
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"both.reqifz is not a ZIP archive"):
        read_requirements(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "")
    with pytest.raises(ValueError, match=r"contains no file .reqif"):
        read_requirements(path)


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp1252"]
)
@pytest.mark.parametrize(
    "text",
    [
        'id,formula,text\nA,"always x < 1","größer, ""sehr"""\n',
        'id;formula;text;\r\nA;always x < 1;"größer, ""sehr"""\r\n;;\r\n',
        "sep=;\r\nid;formula;text\r\nA;always x < 1;\"größer, \"\"sehr\"\"\"\r\n",
        'id\tformula\ttext\nA\talways x < 1\t"größer, ""sehr"""\n',
        "# [notes]\n[[requirement]]\nid = 'A'\nformula = 'always x < 1'\n"
        "text = 'größer, \"sehr\"'\n",
    ],
)  # fmt: skip
def test_encodings_and_separators(tmp_path, encoding, text):
    path = tmp_path / f"some.{'toml' if text.startswith('#') else 'csv'}"
    path.write_bytes(text.encode(encoding))
    told = pytest.warns(UserWarning, match=r"some\..* is not UTF-8, and is read as Windows-1252")
    with told if encoding == "cp1252" else contextlib.nullcontext():
        (found,) = read_requirements(path)
    assert (found.id, found.text) == ("A", 'größer, "sehr"')
    assert found.formula == parse("always x < 1")


@pytest.mark.parametrize(
    ("name", "data", "match"),
    [
        ("a.csv", b"id,text\nA,gr\x81\n", "a.csv is not a text in UTF-8 .byte 13 is 0x81.: save it"
         " as UTF-8"),
        ("a.csv", b"id,text\nA,\0\n", "a.csv is not a text .character 11 is 0.: save it as UTF-8"),
        ("a.csv", "id,text\nA,ö".encode("utf-16")[:-1], "a.csv is not a text in UTF-16"),
        ("a.csv", b"id,formula\nA,always x < 1,5\n", "requirement 1 of .* has the cell '5' below"),
        ("a.csv", b"id,formula,id\nA,x<1,B\n", "more than one column 'id'"),
        ("a.csv", b'id,formula\nA,"x" < 1\n', "a.csv is not CSV"),
        ("a.csv", b"id,formula\nA," + b"x" * 200_000, "a.csv is not CSV: field larger"),
        ("a.csv", b"", "a.csv has no requirement"),
        ("a.toml", b"a = " + b"[" * 5000, "a.toml is not TOML: its values are nested"),
        ("a.toml", b"[[requirement]]\nid" + b".a" * 5000 + b" = 1", "id must be a text; got {'a'"),
        ("a.yaml", b"requirements: " + b"[" * 3000, "a.yaml is nested too deeply|is not YAML"),
        ("a.yaml", b"requirements: [{id: A}]\nconstants: [1]", "constants must be a table of"),
        ("a.reqif", b'<?xml version="1.0" encoding="no-such"?><REQ-IF/>', "a.reqif is not XML"),
        ("a.reqif", b'<?xml version="1.0" encoding="shift_jis"?><REQ-IF/>', "a.reqif is not XML"),
    ],
)  # fmt: skip
def test_files_that_are_refused(tmp_path, name, data, match):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ValueError, match=match):
        read_requirements(path, need_formulas=False)

from __future__ import annotations

import unicodedata

import pytest

from mrgs.errors import ConfigError, SceneError
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.pairs.find import find_pairs
from mrgs.scene import RGB, THERMAL

FILES = {
    "eye/1.jpg": "jpg",
    "eye/2.jpg": "jpg",
    "heat/a.jpg": "png",
    "heat/b.jpg": "png",
    "notes.md": b"...",
}


@pytest.fixture
def paired(photos, tmp_path):
    """The pairs of ``FILES`` that a table names, as (RGB, thermal)."""

    def find(content: str, encoding: str = "utf-8"):
        table = tmp_path / "pairs.csv"
        table.write_bytes(content.encode(encoding))
        root = photos(FILES)
        found = find_pairs(root, PrepareOptions(pair_table=table))
        assert "pairs.csv" in found.rule
        return [
            (
                "" if RGB not in pair.photos else pair.photos[RGB].relative_to(root).as_posix(),
                pair.photos[THERMAL].name,
            )
            for pair in found.pairs
        ]

    return find


BOTH = [("eye/2.jpg", "a.jpg"), ("eye/1.jpg", "b.jpg")]


@pytest.mark.parametrize(
    "content",
    [
        "eye/1.jpg,heat/b.jpg\neye/2.jpg,heat/a.jpg\n",
        "rgb,thermal\neye/2.jpg,heat/a.jpg\n\neye/1.jpg,heat/b.jpg",
        "\ufeffThermal;RGB\r\nheat/b.jpg; eye/1.jpg\r\nheat/a.jpg;eye/2.jpg\r\n",
        '"eye\\2.jpg"\t"heat\\a.jpg"\neye/./1.jpg\theat/b.jpg',
    ],
)
def test_tables(paired, content):
    assert paired(content) == BOTH


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "utf-8", "cp1252"])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_tables_as_spreadsheets_write_them(photos, tmp_path, encoding, separator):
    files = [("Küche – Süd/1.jpg", "Wärme/a.jpg"), ("Küche – Süd/2.jpg", "Wärme/b.jpg")]
    lines = [separator.join(names) for names in [("RGB", "Thermal"), *files]]
    table = tmp_path / "pairs.csv"
    table.write_bytes("\r\n".join([*lines, ""]).encode(encoding))
    root = photos({name: "jpg" for names in files for name in names})
    assert [
        tuple(pair.photos[modality].relative_to(root).as_posix() for modality in (RGB, THERMAL))
        for pair in find_pairs(root, PrepareOptions(pair_table=table)).pairs
    ] == files


def test_photos_that_the_table_does_not_name(photos, tmp_path):
    table = tmp_path / "pairs.csv"
    table.write_text("eye/1.jpg,heat/a.jpg")
    found = find_pairs(photos(FILES), PrepareOptions(pair_table=table))
    assert [(item.name, "pairs.csv" in item.reason) for item in found.skipped] == [
        ("eye/2.jpg", True),
        ("heat/b.jpg", True),
        ("notes.md", False),
    ]


@pytest.mark.parametrize(("in_table", "on_disk"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_names_in_another_unicode_form(photos, tmp_path, in_table, on_disk):
    table = tmp_path / "pairs.csv"
    table.write_text(unicodedata.normalize(in_table, "Küche/ä.jpg,Küche/ö.jpg"), encoding="utf-8")
    content = {
        unicodedata.normalize(on_disk, name): "jpg" for name in ("Küche/ä.jpg", "Küche/ö.jpg")
    }
    found = find_pairs(photos(content), PrepareOptions(pair_table=table))
    assert [(pair.photos[RGB].name, pair.photos[THERMAL].name) for pair in found.pairs] == [
        (unicodedata.normalize(on_disk, "ä.jpg"), unicodedata.normalize(on_disk, "ö.jpg"))
    ]


def test_thermal_photos_alone(paired):
    assert paired(",heat/a.jpg\n,heat/b.jpg") == [("", "a.jpg"), ("", "b.jpg")]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", r"no pairs; .*rgb/a\.jpg,thermal/a\.jpg"),
        ("eye/1.jpg", r"line 1 .*rgb/a\.jpg,thermal/a\.jpg"),
        ("a,b,c", "line 1 does not"),
        ("eye/1.jpg,", "line 1 does not"),
        ("rgb,thermal\neye/9.jpg,heat/a.jpg", r"line 2: .*no 'eye/9\.jpg'"),
        ("../x.jpg,heat/a.jpg", r"line 1: '\.\./x\.jpg' lies outside"),
        ("/etc/passwd,heat/a.jpg", "line 1: '/etc/passwd' lies"),
        ("eye/1.jpg,notes.md", r"line 1: 'notes\.md' is no"),
        ("eye/1.jpg,heat/a.jpg\neye/1.jpg,heat/b.jpg", r"1 and 2 .*eye/1\.jpg"),
        ("eye/1.jpg,eye/1.jpg", "line 1 .*twice"),
        ('"' + "a" * 200_000 + '",b', r"line 1 .*\(field larger"),
    ],
)
def test_tables_that_cannot_be_used(paired, content, message):
    with pytest.raises(SceneError, match=message):
        paired(content)


def test_a_link_that_leads_outside(paired, photos, tmp_path):
    root = photos(FILES)
    (tmp_path / "secret.jpg").write_bytes((root / "eye/1.jpg").read_bytes())
    (root / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    with pytest.raises(SceneError, match=r"'link\.jpg' lies outside"):
        paired("link.jpg,heat/a.jpg")


def test_a_table_that_is_missing(photos, tmp_path):
    with pytest.raises(SceneError, match=r"pairs\.csv: cannot"):
        find_pairs(photos(FILES), PrepareOptions(pair_table=tmp_path / "pairs.csv"))


def test_a_table_and_a_rule(photos, tmp_path):
    with pytest.raises(ConfigError, match=r"table .* rule"):
        find_pairs(photos(FILES), PrepareOptions(pair_table=tmp_path / "pairs.csv", pairs="time"))


def test_visible_photos_inside_and_outside_are_two_cameras(photos, tmp_path):
    root = photos({"a.jpg": "flir with visible", "b.jpg": "flir", "b_rgb.jpg": "jpg"})
    table = tmp_path / "pairs.csv"
    table.write_text(",a.jpg\nb_rgb.jpg,b.jpg")
    with pytest.raises(SceneError, match=r"a\.jpg .*embedded, b_rgb\.jpg"):
        find_pairs(root, PrepareOptions(pair_table=table))

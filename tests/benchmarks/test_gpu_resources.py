from __future__ import annotations

import json
from collections.abc import Callable
from types import ModuleType, SimpleNamespace

import pytest

from benchmarks import gpu_resources
from benchmarks.gpu_compile import listed, parse_log, unlisted
from benchmarks.gpu_resources import (
    DOCUMENT,
    MARKS,
    UPDATE,
    CompilationError,
    compile_in_children,
    environment,
    read_table,
    resident_warps,
    to_markdown,
    update,
    with_newest,
    worsened,
)
from mrgs.kernels.gpu_spec import KernelSpec
from tests.benchmarks.tables import rows

GOOD = {"registers": 40, "spill_stores": 0, "spill_loads": 0, "stack": 0, "shared": 512, "warps": 4}


def found(version: str = "3.9.0", unlisted: tuple[str, ...] = (), **changes: int) -> dict:
    return {
        "triton": version,
        "sources": {"blur: blur": "digest"},
        "unlisted": list(unlisted),
        "kernels": {"blur: blur": {"sm_80": GOOD, "sm_90": {**GOOD, **changes}}},
    }


TABLE_OF_GOOD = {"3.9.0": found()["kernels"]}


@pytest.mark.slow
def test_no_kernel_takes_more_than_the_table_says():
    pytest.importorskip("triton")
    table = read_table()
    assert worsened(compile_in_children(table), table) == []


def test_the_supported_compilers_are_in_the_table():
    table = read_table()
    assert {version.rsplit(".", 1)[0] for version in table} >= {"3.6", "3.7", "3.9"}
    first, *others = [kernels.keys() for kernels in table.values()]
    assert all(keys == first for keys in others)


def test_what_stays_or_shrinks_is_no_finding():
    assert worsened(found(), TABLE_OF_GOOD) == []
    assert worsened(found(registers=30, shared=0), TABLE_OF_GOOD) == []


@pytest.mark.parametrize(
    ("key", "name"),
    [
        ("registers", "registers"),
        ("spill_stores", "spill stores"),
        ("spill_loads", "spill loads"),
        ("stack", "stack"),
        ("shared", "shared memory"),
    ],
)
def test_whatever_grows_is_named_with_both_values_and_the_command(key, name):
    (line,) = worsened(found(**{key: 1000}), TABLE_OF_GOOD)
    assert line.startswith("blur: blur")
    assert line.endswith(UPDATE)
    for each in ("sm_90", name, "1000", str(GOOD[key])):
        assert each in line


def test_of_a_compiler_without_a_table_only_spills_are_findings():
    assert worsened(found("4.0.0", registers=255), TABLE_OF_GOOD) == []
    (line,) = worsened(found("4.0.0", spill_stores=8), TABLE_OF_GOOD)
    assert "sm_90" in line
    assert "spills 8" in line


def test_table_and_lists_hold_the_same_kernels():
    renamed = found()
    renamed["kernels"] = {"blur: smear": renamed["kernels"]["blur: blur"]}
    new, gone = worsened(renamed, TABLE_OF_GOOD)
    assert new.startswith("blur: smear")
    assert gone.startswith("blur: blur")
    assert new.endswith(UPDATE)
    assert gone.endswith(UPDATE)


def test_a_kernel_in_no_list_is_a_finding():
    (line,) = worsened(found(unlisted=("mrgs.kernels.blur.k.lost",)), TABLE_OF_GOOD)
    assert line.startswith("mrgs.kernels.blur.k.lost")
    assert "KERNELS" in line


def fake_kernel(name: str, body: Callable = len) -> SimpleNamespace:
    """What ``triton.jit`` returns, as far as it is looked at."""
    code = getattr(body, "__code__", SimpleNamespace(co_names=()))
    fn = SimpleNamespace(__name__=name, __module__="mrgs.kernels.blur.gpu", __code__=code)
    return SimpleNamespace(fn=fn, __name__=name, arg_names=["x"])


def test_kernels_without_an_entry_are_found_but_not_what_kernels_call():
    module = ModuleType("mrgs.kernels.blur.gpu")
    module.blur = fake_kernel("blur", lambda x: window(x))
    module.window, module.lost = fake_kernel("window"), fake_kernel("lost")
    specs = [KernelSpec(module.blur, {"x": "*fp32"}, {})]
    assert unlisted([module], specs) == ["mrgs.kernels.blur.gpu.lost"]


def test_specialisations_of_a_kernel_need_names_of_their_own():
    blur = fake_kernel("blur")
    module = ModuleType("kernels")
    module.KERNELS = (
        KernelSpec(blur, {"x": "*fp32"}, {}),
        KernelSpec(blur, {}, {"x": None}, variant="bare"),
    )
    assert list(listed([module])) == ["blur: blur", "blur: blur[bare]"]
    module.KERNELS = (module.KERNELS[0], KernelSpec(blur, {}, {"x": None}))
    with pytest.raises(ValueError, match="blur: blur"):
        listed([module])


def test_the_log_of_ptxas_is_read_over_all_functions_of_a_kernel():
    log = """ptxas info    : Compiling entry function 'blur' for 'sm_80'
ptxas info    : Function properties for blur
    8 bytes stack frame, 4 bytes spill stores, 12 bytes spill loads
ptxas info    : Used 40 registers, used 1 barriers, 400 bytes cmem[0]
ptxas info    : Function properties for helper
    16 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 22 registers
"""
    assert parse_log(log) == {"registers": 40, "spill_stores": 4, "spill_loads": 12, "stack": 24}
    with pytest.raises(ValueError, match="ptxas said nothing"):
        parse_log("")


@pytest.mark.parametrize(
    ("changes", "target", "expected"),
    [
        ({"registers": 32, "shared": 0}, "sm_80", 64),
        ({"registers": 33, "shared": 0}, "sm_80", 48),  # 40 registers per thread are handed out
        ({"registers": 255, "shared": 0}, "sm_80", 8),
        ({"registers": 32, "shared": 40 * 1024}, "sm_80", 16),
        ({"registers": 32, "shared": 40 * 1024}, "sm_90", 20),
        ({"registers": 32, "shared": 0, "warps": 1}, "sm_90", 32),  # 32 programs at most
        ({"registers": 32, "shared": 0, "warps": 2}, "sm_90", 64),
    ],
)
def test_resident_warps(changes, target, expected):
    assert resident_warps(target, {**GOOD, **changes}) == expected


def test_a_row_of_the_table():
    text = to_markdown("3.9.0", found(registers=56)["kernels"])
    name, *cells = rows(text)[-1]
    assert "blur: blur" in name
    assert cells == ["4", "40 / 56", "0", "512", "48 / 36"]


def test_the_document_shows_the_newest_compiler():
    text = with_newest(
        f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n",
        {**TABLE_OF_GOOD, "3.10.0": found()["kernels"]},
    )
    assert text.startswith(f"before\n{MARKS[0]}\n\nTriton 3.10.0")
    assert text.endswith(f"\n\n{MARKS[1]}\nafter\n")
    assert "old" not in text


def test_the_committed_document_shows_the_committed_table():
    text = DOCUMENT.read_text(encoding="utf-8")
    assert with_newest(text, read_table()) == text, UPDATE


def test_the_children_compile_whatever_this_process_does(monkeypatch):
    """TRITON_INTERPRET would make them interpret, and options for ptxas would change what they
    measure."""
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    monkeypatch.setenv("TRITON_PTXAS_PATH", "/somewhere")
    assert {key for key in environment("cache") if key.startswith("TRITON_")} == {
        "TRITON_CACHE_DIR",
        "TRITON_DUMP_PTXAS_LOG",
        "TRITON_DEFAULT_FP_FUSION",
    }


def test_every_target_is_compiled_for(tmp_path):
    def child(what, *names):
        if what == "sources":
            return {"triton": "3.9.0", "unlisted": [], "sources": {"blur: blur": "new"}}
        return {name: {**GOOD, "registers": int(what)} for name in names}

    kernels = compile_in_children(None, child, tmp_path / "none.json")["kernels"]["blur: blur"]
    registers = {target: taken["registers"] for target, taken in kernels.items()}
    assert registers == {"sm_80": 80, "sm_90": 90}


def test_what_has_not_changed_since_the_table_was_written_is_not_compiled(tmp_path):
    compiled = []

    def child(what, *names):
        if what == "sources":
            return {"triton": "3.9.0", "unlisted": [], "sources": {"a": "1", "b": "2", "c": "3"}}
        compiled.append((what, *names))
        return dict.fromkeys(names, GOOD)

    sources = tmp_path / "sources.json"
    sources.write_text(json.dumps({"3.9.0": {"a": "1", "b": "old", "c": "3"}}))
    old = {"sm_80": {**GOOD, "registers": 99}, "sm_90": GOOD}
    kernels = compile_in_children({"3.9.0": {"a": old, "b": old}}, child, sources)["kernels"]
    good = {"sm_80": GOOD, "sm_90": GOOD}
    assert kernels == {"a": old, "b": good, "c": good}
    assert sorted(compiled) == [("80", "b", "c"), ("90", "b", "c")]


def test_a_kernel_that_does_not_compile_is_told_as_its_process_tells_it():
    pytest.importorskip("triton")
    with pytest.raises(CompilationError, match="KeyError: 'blur: none'"):
        gpu_resources._child("80", "blur: none")


def test_update_writes_the_part_of_the_installed_compiler_alone(tmp_path):
    files = [tmp_path / name for name in ("table.json", "sources.json", "gpu.md")]
    files[2].write_text("".join(MARKS))
    for each in found("3.6.0", registers=50), found(registers=41), found():
        update(each, *files)
    assert read_table(files[0]) == {"3.6.0": found(registers=50)["kernels"], **TABLE_OF_GOOD}
    assert json.loads(files[1].read_text()).keys() == {"3.6.0", "3.9.0"}
    assert "Triton 3.9.0" in files[2].read_text()

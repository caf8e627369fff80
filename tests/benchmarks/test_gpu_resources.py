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
    TABLE,
    UPDATE,
    CompilationError,
    compile_in_children,
    read_table,
    resident_warps,
    to_markdown,
    with_newest,
    worsened,
)
from mrgs.kernels.gpu_spec import KernelSpec

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
    ("key", "words"),
    [
        ("registers", "1000 registers per thread, and took 40"),
        ("spill_stores", "1000 bytes of spill stores, and took 0"),
        ("spill_loads", "1000 bytes of spill loads, and took 0"),
        ("stack", "1000 bytes of stack, and took 0"),
        ("shared", "1000 bytes of shared memory, and took 512"),
    ],
)
def test_whatever_grows_is_named_with_both_values_and_the_command(key, words):
    expected = f"blur: blur for sm_90 takes {words}; if that is meant: {UPDATE}"
    assert worsened(found(**{key: 1000}), TABLE_OF_GOOD) == [expected]


def test_of_a_compiler_without_a_table_only_spills_are_findings():
    assert worsened(found("4.0.0", registers=255), TABLE_OF_GOOD) == []
    (line,) = worsened(found("4.0.0", spill_stores=8), TABLE_OF_GOOD)
    assert line == "blur: blur for sm_90 spills 8 bytes"


def test_table_and_lists_hold_the_same_kernels():
    renamed = found()
    renamed["kernels"] = {"blur: smear": renamed["kernels"]["blur: blur"]}
    assert worsened(renamed, TABLE_OF_GOOD) == [
        f"blur: smear is not in the table: {UPDATE}",
        f"blur: blur is in the table, but no longer listed: {UPDATE}",
    ]


def test_a_kernel_in_no_list_is_a_finding():
    lines = worsened(found(unlisted=("mrgs.kernels.blur.k.lost",)), TABLE_OF_GOOD)
    assert lines == [
        "mrgs.kernels.blur.k.lost is in no KERNELS: list every specialisation that is launched"
    ]


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
    with pytest.raises(ValueError, match="two entries of KERNELS are called blur: blur"):
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
    assert "| `blur: blur` | 4 | 40 / 56 | 0 | 512 | 48 / 36 |" in text


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
    started = []

    def run(command, env, **options):
        started.append(env)
        return SimpleNamespace(returncode=0, stdout=json.dumps(answer(command)), stderr="")

    def answer(command):
        if command[-1] == "sources":
            return {"triton": "3.9.0", "unlisted": [], "sources": {"blur: blur": "new"}}
        assert command[-1] == "blur: blur"
        return {"blur: blur": {**GOOD, "registers": int(command[-2])}}

    monkeypatch.setenv("TRITON_INTERPRET", "1")
    monkeypatch.setenv("TRITON_PTXAS_PATH", "/somewhere")
    monkeypatch.setattr(gpu_resources.subprocess, "run", run)
    kernels = compile_in_children()["kernels"]["blur: blur"]
    assert {target: taken["registers"] for target, taken in kernels.items()} == {
        "sm_80": 80,
        "sm_90": 90,
    }
    for environment in started:
        triton_variables = {key for key in environment if key.startswith("TRITON_")}
        assert triton_variables == {
            "TRITON_CACHE_DIR",
            "TRITON_DUMP_PTXAS_LOG",
            "TRITON_DEFAULT_FP_FUSION",
        }


def test_what_has_not_changed_since_the_table_was_written_is_not_compiled(monkeypatch, tmp_path):
    compiled = []

    def child(what, *names):
        if what == "sources":
            return {"triton": "3.9.0", "unlisted": [], "sources": {"a": "1", "b": "2", "c": "3"}}
        compiled.append((what, *names))
        return dict.fromkeys(names, GOOD)

    monkeypatch.setattr(gpu_resources, "_child", child)
    monkeypatch.setattr(gpu_resources, "SOURCES", tmp_path / "sources.json")
    gpu_resources.SOURCES.write_text(json.dumps({"3.9.0": {"a": "1", "b": "old", "c": "3"}}))
    old = {"sm_80": {**GOOD, "registers": 99}, "sm_90": GOOD}
    kernels = compile_in_children({"3.9.0": {"a": old, "b": old}})["kernels"]
    good = {"sm_80": GOOD, "sm_90": GOOD}
    assert kernels == {"a": old, "b": good, "c": good}
    assert sorted(compiled) == [("80", "b", "c"), ("90", "b", "c")]


def test_a_kernel_that_does_not_compile_is_told_as_the_compiler_tells_it(monkeypatch):
    failed = SimpleNamespace(returncode=1, stdout="", stderr="CompilationError: at 7:4\n")
    monkeypatch.setattr(gpu_resources.subprocess, "run", lambda *_, **__: failed)
    with pytest.raises(CompilationError, match="at 7:4"):
        compile_in_children()


def test_update_writes_the_part_of_the_installed_compiler_alone(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(gpu_resources, "TABLE", tmp_path / TABLE.name)
    monkeypatch.setattr(gpu_resources, "SOURCES", tmp_path / "sources.json")
    monkeypatch.setattr(gpu_resources, "DOCUMENT", tmp_path / DOCUMENT.name)
    gpu_resources.DOCUMENT.write_text("".join(MARKS))
    monkeypatch.setattr(gpu_resources, "compile_in_children", lambda: found("3.6.0", registers=50))
    assert gpu_resources.main(["--update"]) == 0
    monkeypatch.setattr(gpu_resources, "compile_in_children", found)
    assert gpu_resources.main(["--update"]) == 0
    assert gpu_resources.read_table() == {"3.6.0": found(registers=50)["kernels"], **TABLE_OF_GOOD}
    monkeypatch.setattr(gpu_resources, "compile_in_children", lambda: found(registers=41))
    assert gpu_resources.main([]) == 1
    assert "takes 41 registers per thread, and took 40" in capsys.readouterr().err
    assert gpu_resources.read_table()["3.9.0"] == found()["kernels"]
    assert "Triton 3.9.0" in gpu_resources.DOCUMENT.read_text()

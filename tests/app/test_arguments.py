"""The list of commands, messages for wrong arguments, and shell completion."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import mrgs
from mrgs.app import commands
from mrgs.app.cli import main
from mrgs.app.terminal import styled
from mrgs.export.formats import FORMATS
from mrgs.runs.registry import registered_methods


def ended(code: int, *arguments: str) -> None:
    with pytest.raises(SystemExit) as end:
        main([*arguments])
    assert end.value.code == code


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",), ("help",)])
def test_without_a_command_all_are_listed_in_one_line_each(arguments, capsys):
    ended(0, *arguments)
    lines = capsys.readouterr().out.splitlines()
    listed = [line.split()[0] for line in lines if line.startswith("  ")]
    assert listed == [*commands.COMMANDS]
    assert max(map(len, lines)) <= 90


def test_the_version_is_printed(capsys):
    ended(0, "--version")
    assert capsys.readouterr().out == f"mrgs {mrgs.__version__}\n"


@pytest.mark.parametrize(
    ("typed", "remedy"),
    [("tarin", "train?"), ("exprot", "export?"), ("photos", "`mrgs`"), ("--output", "`mrgs`")],
)
def test_an_unknown_command_is_one_line(typed, remedy, capsys):
    ended(2, typed)
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("mrgs: error: ")
    assert typed in line
    assert remedy in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("measure", "run", "--emissivity", "90%"), ["--emissivity", "90%"]),
        (("prepare", "a", "b", "--bounds", "-5", "warm"), ["--bounds", "warm"]),
        (("train", "a", "--max-steps", "4.5"), ["--max-steps", "4.5"]),
    ],
)
def test_an_option_that_takes_a_number_is_named(arguments, words, capsys):
    ended(2, *arguments)
    printed = capsys.readouterr().err
    assert all(word in printed for word in words)


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_help_explains_every_option(name, capsys):
    ended(0, name, "--help")
    text = capsys.readouterr().out
    fields = [*dataclasses.fields(commands.COMMANDS[name])]
    groups = {"photo": commands.PhotoOptions, "settings": commands.PhotoSettings}
    for field in [each for each in fields if each.default is dataclasses.MISSING]:
        if field.name in groups and field.default_factory is groups[field.name]:
            fields.remove(field)
            fields += dataclasses.fields(groups[field.name])
    for field in fields:
        positional = field.default is dataclasses.MISSING
        option = "positional arguments" if positional else f"--{field.name.replace('_', '-')} "
        assert option in text
    assert "None" not in text


@pytest.mark.parametrize(
    "kind", [*commands.COMMANDS.values(), commands.PhotoOptions, commands.PhotoSettings]
)
def test_help_of_an_option_is_one_line_in_the_code(kind):
    """tyro would keep the line break and the indentation."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body[1:]
    values = [node.value for node in body if isinstance(node, ast.Expr)]
    texts = [ast.literal_eval(value) for value in values]
    assert [text for text in texts if "\n" in text] == []


def test_lists_of_choices_are_complete(capsys):
    ended(0, "train", "--help")
    text = re.sub(r"[\s│]", "", capsys.readouterr().out)
    assert "{" + ",".join(method.name for method in registered_methods()) + "}" in text
    ended(0, "compare", "--help")
    text = re.sub(r"[\s│]", "", capsys.readouterr().out)
    assert ",".join(method.name for method in registered_methods()) in text
    ended(0, "export", "--help")
    assert "{" + ",".join(["all", *FORMATS]) + "}" in capsys.readouterr().out


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["mrgs", "tr"], {"train"}),
        (["mrgs", "export", "--for"], {"--format"}),
        (["mrgs", "render", "--palette", "in"], {"inferno"}),
    ],
)
def test_the_shell_completes(words, found, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["--tyro-print-completion", "bash"])
    script = tmp_path / "mrgs.sh"
    script.write_text(capsys.readouterr().out)
    line = " ".join(words)
    asked = (
        f"source {script}; COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; COMP_LINE='{line}'; "
        f"COMP_POINT={len(line)}; $(complete -p mrgs | sed 's/.*-F *\\([^ ]*\\).*/\\1/'); "
        'echo "${COMPREPLY[@]}"'
    )
    bash = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, check=True)
    assert found <= set(bash.stdout.split()), bash.stderr


class Terminal:
    """Standard error as a terminal has it."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        assert text == "", "the text is returned, not written"
        return 0

    def flush(self) -> None: ...


def test_colours_only_where_they_are_wanted(monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert styled("late", "bold red", sys.stderr) == "late"
    coloured = styled("late", "bold red", Terminal())
    assert "\033[" in coloured
    assert "late" in coloured
    monkeypatch.setenv("NO_COLOR", "1")
    assert styled("late", "bold red", Terminal()) == "late"


def test_a_module_is_the_command():
    source = Path(mrgs.__file__).parents[1]
    run = subprocess.run(
        [sys.executable, "-m", "mrgs", "--version"],
        capture_output=True, text=True, check=True, env={"PYTHONPATH": str(source)},
    )  # fmt: skip
    assert run.stdout == f"mrgs {mrgs.__version__}\n"


def test_a_reader_that_leaves_early_is_no_error():
    source = Path(mrgs.__file__).parents[1]
    with subprocess.Popen(
        [sys.executable, "-m", "mrgs", "prepare", "--help"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={"PYTHONPATH": str(source)},
    ) as process:  # fmt: skip
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        assert process.stderr.read() == b""

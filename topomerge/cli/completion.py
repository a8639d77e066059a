"""The command `completion`: scripts for bash, zsh and fish, written from the table of commands.

A script stands alone: pressing Tab starts no Python. It knows the commands, their options, the values of options that have
choices, and where a file or a folder comes; after an update that brings new options it is to be printed again.
`docs/adr/0007-shell-completion.md` says why this is not left to a library.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from topomerge.cli.console import Command, build_option, write_out

SHELLS = ("bash", "zsh", "fish")
FOLDER_METAVARS = ("DIR", "FOLDER")


@dataclass(frozen=True)
class CompletionWord:
    """An option, or an argument without a flag (`flags` is empty), which may `repeat`."""

    flags: tuple[str, ...]
    help: str
    value: str  # "none", "file", "folder", "other" or "choice"
    choices: tuple[str, ...] = ()
    repeat: bool = False


def run_completion(args: argparse.Namespace) -> int:
    """`topomerge completion`: print the script that completes all of `args.commands`."""
    write_out(build_script(args.shell, args.commands))
    return 0


def build_script(shell: str, commands: Sequence[Command]) -> str:
    """Build the script that completes `topomerge` in a shell.

    Args:
        shell: one of `SHELLS`.
        commands: those that it shall know.
    """
    names = {
        c.name: [*(_build_word(flags, settings, c.paths) for flags, settings in c.arguments), *COMMON_OPTIONS] for c in commands
    }
    return {"bash": _build_bash_script, "zsh": _build_zsh_script, "fish": _build_fish_script}[shell](
        names, {c.name: c.summary for c in commands}
    )


COMMON_OPTIONS = (
    CompletionWord(("-v", "--verbose"), "tell more", "none"),
    CompletionWord(("-h", "--help"), "show the help", "none"),
)


def _build_word(flags: tuple[str, ...], settings: dict[str, Any], paths: tuple[str, ...]) -> CompletionWord:
    option_flags = flags if flags[0].startswith("-") else ()
    dest = settings.get("dest") or next((f for f in flags if f.startswith("--")), flags[0]).lstrip("-").replace("-", "_")
    choices = tuple(str(c) for c in settings.get("choices") or ())
    if settings.get("action") in ("store_true", "store_false", "count"):
        value = "none"
    elif choices:
        value = "choice"
    elif dest in paths:
        value = "folder" if settings.get("metavar") in FOLDER_METAVARS else "file"
    else:
        value = "other"
    return CompletionWord(option_flags, settings.get("help") or "", value, choices, settings.get("nargs") in ("*", "+"))


def _list_flags(words: Iterable[CompletionWord]) -> list[str]:
    return [flag for word in words for flag in word.flags]


def _format_bash_value(word: CompletionWord) -> str:
    return {"choice": f'_words "{" ".join(word.choices)}"', "file": "_files -f", "folder": "_files -d"}.get(word.value, ":")


def _iter_bash_cases(command: str, words: Sequence[CompletionWord]) -> Iterable[str]:
    """Yield the cases of bash: its offers after each option that takes a value, and for each argument without a flag."""
    for word in words:
        if word.flags and word.value != "none":
            pattern = "|".join(f'"{command} {flag}"' for flag in word.flags)
            yield f"    {pattern}) {_format_bash_value(word)}; return ;;"


def _iter_bash_positions(command: str, words: Sequence[CompletionWord]) -> Iterable[str]:
    for place, word in enumerate(w for w in words if not w.flags):
        yield f'    "{command} "{"*" if word.repeat else place}) {_format_bash_value(word)} ;;'


def _build_bash_script(words: dict[str, list[CompletionWord]], summaries: dict[str, str]) -> str:
    del summaries
    takes_value = {f'"{name} {flag}"' for name, all in words.items() for w in all if w.value != "none" for flag in w.flags}
    return BASH_SCRIPT % {
        "names": " ".join(words),
        "takes_value": "|".join(sorted(takes_value)),
        "cases": "\n".join(line for name, all in words.items() for line in _iter_bash_cases(name, all)),
        "options": "\n".join(f'    {name}) _words "{" ".join(_list_flags(all))}" ;;' for name, all in words.items()),
        "positions": "\n".join(line for name, all in words.items() for line in _iter_bash_positions(name, all)),
    }


BASH_SCRIPT = """\
# Completion of topomerge for bash. Written by: topomerge completion bash >> ~/.bashrc
_topomerge() {
  local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]} command= place=0 i
  [[ $word == = ]] && word=
  [[ $before == = ]] && before=${COMP_WORDS[COMP_CWORD-2]}
  COMPREPLY=()
  _words() { COMPREPLY=($(compgen -W "$1" -- "$word")); }
  _files() { local IFS=$'\\n'; compopt -o filenames; COMPREPLY=($(compgen "$1" -- "$word")); }
  for ((i = 1; i < COMP_CWORD; i++)); do
    [[ ${COMP_WORDS[i]} != -* ]] && { command=${COMP_WORDS[i]}; break; }
  done
  if [[ -z $command ]]; then
    _words "%(names)s --help --version"
    return
  fi
  for ((i++; i < COMP_CWORD; i++)); do  # how many arguments without a flag stand before the word
    [[ ${COMP_WORDS[i]} == -* || ${COMP_WORDS[i]} == = || ${COMP_WORDS[i-1]} == = ]] && continue
    case "$command ${COMP_WORDS[i-1]}" in
      %(takes_value)s) ;;
      *) ((place++)) ;;
    esac
  done
  case "$command $before" in
%(cases)s
  esac
  if [[ $word == -* ]]; then
    case $command in
%(options)s
    esac
    return
  fi
  case "$command $place" in
%(positions)s
  esac
}
complete -F _topomerge topomerge
"""


def _strip_shell_signs(text: str) -> str:
    """Strip a text of the signs that mean something to a shell."""
    return re.sub(r"[\[\]:'\"\\`$]", "", " ".join(text.split()))


def _format_zsh_value(word: CompletionWord) -> str:
    action = {"file": "_files", "folder": "_files -/", "choice": f"({' '.join(word.choices)})", "other": " "}.get(word.value, "")
    return f":value:{action}" if action else ""


def _build_zsh_script(words: dict[str, list[CompletionWord]], summaries: dict[str, str]) -> str:
    names = "\n".join(f"    '{name}:{_strip_shell_signs(text)}'" for name, text in summaries.items())
    cases = []
    for name, all in words.items():
        specs = [
            f"'{flag}{'=' if flag.startswith('--') and w.value != 'none' else ''}["
            f"{_strip_shell_signs(w.help)}]{_format_zsh_value(w)}'"
            for w in all
            for flag in w.flags
        ]
        positional = [w for w in all if not w.flags]
        specs += [f"'{'*' if w.repeat else place}{_format_zsh_value(w)}'" for place, w in enumerate(positional, 1)]
        cases.append(f"    {name}) _arguments " + " ".join(specs) + " ;;")
    return ZSH_SCRIPT % {"names": names, "cases": "\n".join(cases)}


ZSH_SCRIPT = """\
# Completion of topomerge for zsh. Written by: topomerge completion zsh >> ~/.zshrc
_topomerge() {
  local -a names
  names=(
%(names)s
  )
  if (( CURRENT == 2 )); then
    _describe command names
    _arguments '--help[show the help]' '--version[show the version]'
    return
  fi
  local command=$words[2]
  shift words
  (( CURRENT-- ))
  case $command in
%(cases)s
  esac
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit -u }
compdef _topomerge topomerge
"""


def _build_fish_script(words: dict[str, list[CompletionWord]], summaries: dict[str, str]) -> str:
    lines = [
        "# Completion of topomerge for fish. Written by: topomerge completion fish > ~/.config/fish/completions/topomerge.fish",
        "complete -c topomerge -f",
    ]
    lines += [
        f"complete -c topomerge -n __fish_use_subcommand -l {name} -d '{text}'"
        for name, text in (("help", "show the help"), ("version", "show the version"))
    ]
    lines += [
        f"complete -c topomerge -n __fish_use_subcommand -a {n} -d '{_strip_shell_signs(text)}'" for n, text in summaries.items()
    ]
    for name, all in words.items():
        start = f"complete -c topomerge -n '__fish_seen_subcommand_from {name}'"
        lines += [f"{start} {_format_fish_word(word)}" for word in all]
    return "\n".join(lines) + "\n"


def _format_fish_word(word: CompletionWord) -> str:
    flags = [f"-l {f[2:]}" if f.startswith("--") else f"-s {f[1:]}" for f in word.flags]
    values = {"file": "-r -F", "folder": "-x -a '(__fish_complete_directories)'", "other": "-x", "none": ""}
    value = f"-x -a '{' '.join(word.choices)}'" if word.choices else values[word.value]
    if not word.flags:
        value = value.replace("-r ", "").replace("-x ", "")
    return " ".join([*flags, value, f"-d '{_strip_shell_signs(word.help)}'" if word.flags else ""]).strip()


COMPLETION = Command(
    "completion",
    run_completion,
    "print a script that completes commands and options in your shell",
    "topomerge completion bash >> ~/.bashrc",
    (build_option("shell", choices=SHELLS, help="the shell that is to learn it"),),
    description="Print a script with which the Tab key completes commands, options and their values: for bash to go into "
    "~/.bashrc, for zsh into ~/.zshrc, for fish into ~/.config/fish/completions/topomerge.fish.",
)

"""Shell completion: scripts for bash, zsh and fish, written from the table of commands.

A script stands alone: pressing Tab starts no Python. It knows the commands, their options, the values of options that have
choices, and where a file or a folder comes; after an update that brings new options it is to be printed again.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

SHELLS = ("bash", "zsh", "fish")
FOLDER = ("DIR", "FOLDER")  # metavars


@dataclass(frozen=True)
class Word:
    """An option, or an argument without a flag (`flags` is empty)."""

    flags: tuple[str, ...]
    help: str
    value: str  # "none", "file", "folder", "other" or "choice"
    choices: tuple[str, ...] = ()


def script(shell: str, commands: Sequence[Any]) -> str:
    """The script that completes `topomerge` in a shell.

    Args:
        shell: "bash", "zsh" or "fish".
        commands: as `topomerge.cli.commands.COMMANDS`: `name`, `summary`, `arguments` and `paths` of each.
    """
    words = {c.name: [*(_word(flags, more, c.paths) for flags, more in c.arguments), *COMMON] for c in commands}
    return {"bash": _bash, "zsh": _zsh, "fish": _fish}[shell](words, {c.name: c.summary for c in commands})


COMMON = (
    Word(("-v", "--verbose"), "tell more", "none"),
    Word(("-h", "--help"), "show the help", "none"),
)


def _word(flags: tuple[str, ...], settings: dict[str, Any], paths: tuple[str, ...]) -> Word:
    named = flags if flags[0].startswith("-") else ()
    dest = settings.get("dest") or next((f for f in flags if f.startswith("--")), flags[0]).lstrip("-").replace("-", "_")
    choices = tuple(str(c) for c in settings.get("choices") or ())
    if settings.get("action") in ("store_true", "store_false", "count"):
        value = "none"
    elif choices:
        value = "choice"
    elif dest in paths:
        value = "folder" if settings.get("metavar") in FOLDER else "file"
    else:
        value = "other"
    return Word(named, settings.get("help") or "", value, choices)


def _options(words: Iterable[Word]) -> list[str]:
    return [flag for word in words for flag in word.flags]


def _cases(command: str, words: Iterable[Word]) -> Iterable[str]:
    """What bash offers after each option that takes a value."""
    for word in words:
        if not word.flags or word.value == "none":
            continue
        pattern = "|".join(f'"{command} {flag}"' for flag in word.flags)
        offer = {"choice": f'_words "{" ".join(word.choices)}"', "file": "_files -f", "folder": "_files -d"}.get(word.value, ":")
        yield f"    {pattern}) {offer}; return ;;"


def _bash(words: dict[str, list[Word]], about: dict[str, str]) -> str:
    del about
    cases = "\n".join(line for name, all in words.items() for line in _cases(name, all))
    options = "\n".join(f'    {name}) _words "{" ".join(_options(all))}" ;;' for name, all in words.items())
    rest = "\n".join(f"    {name}) {_positional_bash(all)} ;;" for name, all in words.items() if any(not w.flags for w in all))
    return BASH % {"names": " ".join(words), "cases": cases, "options": options, "rest": rest}


def _positional_bash(words: Iterable[Word]) -> str:
    word = next(w for w in words if not w.flags)
    return f'_words "{" ".join(word.choices)}"' if word.choices else "_files -f" if word.value == "file" else ":"


BASH = """\
# Completion of topomerge for bash. Written by: topomerge completion bash >> ~/.bashrc
_topomerge() {
  local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]} command= i
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
  case "$command $before" in
%(cases)s
  esac
  if [[ $word == -* ]]; then
    case $command in
%(options)s
    esac
    return
  fi
  case $command in
%(rest)s
  esac
}
complete -F _topomerge topomerge
"""


def _plain(text: str) -> str:
    """Words that mean nothing to a shell."""
    return re.sub(r"[\[\]:'\"\\`$]", "", " ".join(text.split()))


def _zsh_value(word: Word) -> str:
    action = {"file": "_files", "folder": "_files -/", "choice": f"({' '.join(word.choices)})", "other": " "}.get(word.value, "")
    return f":value:{action}" if action else ""


def _zsh(words: dict[str, list[Word]], about: dict[str, str]) -> str:
    names = "\n".join(f"    '{name}:{_plain(text)}'" for name, text in about.items())
    cases = []
    for name, all in words.items():
        specs = [
            f"'{flag}{'=' if flag.startswith('--') and w.value != 'none' else ''}[{_plain(w.help)}]{_zsh_value(w)}'"
            for w in all
            for flag in w.flags
        ]
        word = next((w for w in all if not w.flags), None)
        if word is not None:
            specs.append(f"'*{_zsh_value(word)}'")
        cases.append(f"    {name}) _arguments " + " ".join(specs) + " ;;")
    return ZSH % {"names": names, "cases": "\n".join(cases)}


ZSH = """\
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


def _fish(words: dict[str, list[Word]], about: dict[str, str]) -> str:
    lines = [
        "# Completion of topomerge for fish. Written by: topomerge completion fish > ~/.config/fish/completions/topomerge.fish",
        "complete -c topomerge -f",
    ]
    lines += [f"complete -c topomerge -n __fish_use_subcommand -a {n} -d '{_plain(text)}'" for n, text in about.items()]
    for name, all in words.items():
        here = f"complete -c topomerge -n '__fish_seen_subcommand_from {name}'"
        lines += [f"{here} {_fish_word(word)}" for word in all]
    return "\n".join(lines) + "\n"


def _fish_word(word: Word) -> str:
    flags = [f"-l {f[2:]}" if f.startswith("--") else f"-s {f[1:]}" for f in word.flags]
    value = {"file": "-r -F", "folder": "-x -a '(__fish_complete_directories)'", "other": "-x", "none": ""}
    given = f"-x -a '{' '.join(word.choices)}'" if word.choices else value[word.value]
    if not word.flags:
        given = given.replace("-r ", "").replace("-x ", "")
    return " ".join([*flags, given, f"-d '{_plain(word.help)}'" if word.flags else ""]).strip()

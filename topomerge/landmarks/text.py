"""Text on signs: what readers take for one another, and how much a string tells of a place.

Assumptions, stated as numbers and not fitted: a reader errs on each character independently; what it confuses within a class of
shapes (O and 0, 1 and I and l) costs nothing here, as both strings are folded to one character a class; most of its other errors
are pairs that look alike (`ALIKE`), and the rest is one of `ALPHABET` characters. Punctuation, case and accents are dropped. A
string may be cut off at an end, as signs are seen from the side.
"""

from __future__ import annotations

import re
import unicodedata
from functools import lru_cache

from topomerge.types import LONGEST_FOLDED, fold_text

ALPHABET = 15.0  # characters that an error may give
SUBSTITUTED, SHIFTED = 0.7, 0.15  # of the errors: another character; one too many, and as many one too few
# Characters of two classes that look alike in print, so that readers commonly take them for each other.
_PAIRS = "172706086968563835494a0c9ccehnmnuvvykxef1t7trn8rar6b0a"
ALIKE = frozenset(frozenset(pair) for pair in zip(_PAIRS[::2], _PAIRS[1::2], strict=True))
ALIKE_SHARE, ALIKE_CHARACTERS = 0.6, 4.0  # of the wrong characters: those that look alike; and how many these are for each
CUT_OFF = 0.02  # probability that a string lost an end of half its length at most
WORD_ODDS = {0: 0.3, 1: 0.05, 2: 0.02, 3: 0.005}  # share of the signs that bear a given string of so many characters
NUMBER_ODDS = {1: 1 / 8, 2: 1 / 25, 3: 1 / 120}  # the same of digits: of a storey's rooms, hundreds are few
RAREST = 1 / 1500
MOST_SHIFTED = 100  # numbers by which the rooms of another part of a building count on
COMMON = 0.02  # share of the signs from which on a string stands in every building
MISREAD = 7  # characters of a word, of which one may be wrong without making it another
LETTER_ODDS = 1 / 5  # that a number bears this letter
# Words that stand in every building, in languages of our data: (pattern of the whole string, share of all signs, by guess).
EVERYWHERE = tuple(
    (re.compile(pattern), share)
    for share, pattern in (
        (0.1, r"(fire |emergency |way )?(exit|out)|notausgang|ausgang|fluchtweg|salida( de emergencia)?|sortie( de secours)?"),
        (0.1, r"uscita.*|n[oö]dutg[aå]ng|utg[aå]ng|nooduitgang|uitgang|wyj[sś]cie.*|sa[ií]da.*|出口|非常口|安全出口"),
        (0.05, r"wc|toilets?|toiletten?|restrooms?|bath ?rooms?|herren|damen|gentlemen|(wo)?men|ladies|h|d|m|f|aseos?|toilettes"),
        (0.04, r"(floor|level|ebene|etage|stock|piso|planta|piano|plan|v[aå]ning) ?-?\d{1,2}"),
        (0.04, r"-?\d{1,2}(st|nd|rd|th|\.)? ?(floor|level|[eé]tage|stock|og|ug|obergeschoss|piso|planta|piano|v[aå]ning|fl)"),
        (0.04, r"eg|kg|ug|dg|rdc|ground floor|basement|lobby|erdgeschoss|keller|rez[- ]de[- ]chauss[eé]e"),
        (
            0.04,
            r"push|pull|dr[uü]cken|ziehen|pousse[rz]|tire[rz]|empujar|tirar|spingere|no smoking|rauchen verboten|fire( alarm)?",
        ),
        (
            0.03,
            r"private?|privat|staff( only)?|no entry|(kein )?zutritt( verboten)?|authori[sz]ed.*|caution.*|warning.*|danger.*",
        ),
        (
            0.03,
            r"(lift|elevator|aufzug|fahrstuhl|ascens[eo]u?re?|hiss|stairs?|treppe(nhaus)?|escaliers?|escaleras?)( ?[a-d1-4])?",
        ),
        (0.03, r"(bed|living|dining|bath|class|laundry|wash|meeting|seminar|server|store|copy|printer|break|waiting) ?room.*"),
        (
            0.03,
            r"kitchen(ette)?|office|corridor|hall(way)?|entr(y|ance|[eé]e)|balcony|terrace|closet|pantry|garage|storage|study",
        ),
        (0.03, r"k[uü]che|b[uü]ro|flur|diele|bad|(wohn|schlaf|ess|kinder)?zimmer|lager|teek[uü]che|besprechung.*"),
        (0.03, r"cuisine|bureau|couloir|chambre|salon|s[eé]jour|cocina|oficina|pasillo|dormitorio|cucina|ufficio|camera|k[oö]k"),
        (0.02, r"reception|information|info|empfang|accueil|recepci[oó]n|welcome|willkommen|open|closed|ge[oö]ffnet|geschlossen"),
    )
)


@lru_cache(maxsize=65536)
def is_number(text: str) -> bool:
    """Return whether a string is a number of a room or the like, with letters perhaps, or read as one."""
    folded = fold_text(text)
    digits = sum(c.isdigit() for c in text[: 4 * LONGEST_FOLDED])
    return bool(folded) and len(folded) <= 8 and (folded.isdigit() or 2 * digits >= len(folded))


@lru_cache(maxsize=65536)
def is_common(text: str) -> bool:
    """Return whether a string stands in every building."""
    return estimate_share(text) >= COMMON and not is_number(text)


@lru_cache(maxsize=65536)
def estimate_share(text: str) -> float:
    """Estimate the share of the signs of buildings at large that bear this string."""
    plain = " ".join(unicodedata.normalize("NFKC", text[: 4 * LONGEST_FOLDED]).casefold().split()).strip(".,:;!- ")
    everywhere = max((share for pattern, share in EVERYWHERE if pattern.fullmatch(plain)), default=0.0)
    folded = fold_text(text)
    if is_number(text):
        digits = sum(c.isdigit() for c in folded)
        rare = NUMBER_ODDS.get(digits, 1 / 600) * LETTER_ODDS ** (len(folded) - digits)
    else:
        rare = WORD_ODDS.get(len(folded), RAREST)
    return max(everywhere, rare, RAREST)


@lru_cache(maxsize=262144)
def count_edits(one: str, other: str) -> tuple[int, int, int]:
    """Count the edits of the alignment with the fewest: characters that look alike, that do not, and one too many or too few."""
    if one == other:
        return 0, 0, 0
    row = [(k, k, 0, 0) for k in range(len(other) + 1)]  # edits, too many or few, unlike, alike
    for i, c in enumerate(one, 1):
        last, row = row, [(i, i, 0, 0)]
        for j, d in enumerate(other, 1):
            alike = c != d and frozenset((c, d)) in ALIKE
            steps = [(last[j - 1], 0, int(c != d and not alike), int(alike)), (last[j], 1, 0, 0), (row[j - 1], 1, 0, 0)]
            row.append(min((s[0] + gap + un + al, s[1] + gap, s[2] + un, s[3] + al) for s, gap, un, al in steps))
    return row[-1][3], row[-1][2], row[-1][1]


def score_reading(one: str, other: str, error: float) -> float:
    """Return the probability that a sign that one reader gave as `one` is given as `other` by another one.

    Args:
        one, other: folded strings; the order does not matter.
        error: of a character, by one reader, beyond its class of shapes.
    """
    wrong = min(2 * error, 0.9)
    alike, changed, shifted = count_edits(one, other)
    same = max(max(len(one), len(other), 1) - alike - changed - shifted, 0)
    read = (1 - wrong) ** same * (wrong * SUBSTITUTED * ALIKE_SHARE / ALIKE_CHARACTERS) ** alike
    read *= (wrong * SUBSTITUTED * (1 - ALIKE_SHARE) / ALPHABET) ** changed * (wrong * SHIFTED / ALPHABET**0.5) ** shifted
    if is_cut_off(one, other):
        read = max(read, CUT_OFF * (1 - wrong) ** min(len(one), len(other)))
    return float(read)


def is_cut_off(one: str, other: str) -> bool:
    """Return whether one of two folded strings may be the other one, of which an end of half its length at most is missing."""
    short, long = sorted((one, other), key=len)
    return len(short) < len(long) <= 2 * len(short) and (long.startswith(short) or long.endswith(short))


def is_misread(one: str, other: str) -> bool:
    """Return whether two folded words are one but for a character in seven: numbers are not, of which each character counts."""
    shorter = min(len(one), len(other))
    if is_number(one) or is_number(other) or abs(len(one) - len(other)) > shorter // MISREAD:
        return False
    return sum(count_edits(one, other)) <= shorter // MISREAD


def score_neighbour(one: str, other: str) -> float:
    """Return the probability that a sign beside, above or opposite one that bears a number bears this other one: numbers of one
    building differ in few digits (rooms count up, storeys and wings change one character)."""
    if len(one) != len(other) or one == other:
        return 0.0
    changed = sum(c != d for c, d in zip(one, other, strict=True))
    length = len(one)
    if changed == 1:
        return 0.4 / (9 * length)
    return 0.3 / (81 * length * (length - 1) / 2) if changed == 2 else 0.0


Shift = tuple[str, int, str]


def find_shifts(one: str, other: str) -> list[Shift]:
    """Find what may turn one number into another, but for what a reader got wrong.

    Returns:
        ("change", place, "from>to") of a character, ("count", amount, "") by which the last digits count on; some or none.
    """
    shifts: list[Shift] = []
    if len(one) == len(other):
        differ = [k for k, (c, d) in enumerate(zip(one, other, strict=True)) if c != d]
        if len(differ) <= 2:  # with the noise of a reader
            shifts += [("change", k, f"{one[k]}>{other[k]}") for k in differ]
    tails = [re.search(r"\d{1,6}$", text) for text in (one, other)]
    if tails[0] and tails[1] and one[: tails[0].start()] == other[: tails[1].start()]:
        amount = int(tails[1][0]) - int(tails[0][0])
        shifts += [("count", amount, "")] if 0 < abs(amount) <= MOST_SHIFTED else []
    return shifts


def is_leading(shift: Shift) -> bool:
    """Return whether a shift changes the character that tells the storey or the wing: one of the first two."""
    return shift[0] == "change" and shift[1] <= 1


def apply_shift(text: str, shift: Shift) -> str | None:
    """Return what a number becomes by a shift of `find_shifts`; None where the shift does not apply."""
    how, amount, change = shift
    if how == "change":
        before, after = change.split(">")
        return text[:amount] + after + text[amount + 1 :] if text[amount : amount + 1] == before else None
    tail = re.search(r"\d{1,6}$", text)
    if tail is None or int(tail[0]) + amount < 0:
        return None
    return text[: tail.start()] + str(int(tail[0]) + amount).zfill(len(tail[0]))


def score_shifted(one: str, other: str, shift: Shift, error: float) -> float:
    """Return the probability that readers give `one` and `other` of two numbers of which the second is the first one's shift."""
    how, amount, change = shift
    back = (how, amount, ">".join(change.split(">")[::-1])) if how == "change" else (how, -amount, "")
    moved, moved_back = apply_shift(one, shift), apply_shift(other, back)
    ahead = 0.0 if moved is None else score_reading(moved, other, error)
    return max(ahead, 0.0 if moved_back is None else score_reading(one, moved_back, error))


def quote_text(text: str, longest: int = 24) -> str:
    """Return a string of a stranger as it may be printed: in one line, without control characters, not too long."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    plain = " ".join(plain.split())
    return plain if len(plain) <= longest else plain[: longest - 1] + "…"

"""An interpreter of the SCL that the PLC kit emits: typed, so that what TIA Portal would not compile fails here too.

Subset: one function block; Bool, Byte, Word, DWord, UInt, UDInt, Real, String and TON_TIME; assignments, IF, calls of
TON instances and of the conversions between UInt and Word, UDInt and DWord.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

_TOKEN = re.compile(
    r"\s*(?:(?P<note>//[^\n]*)|(?P<time>T#\d+(?:ms|s))|(?P<name>#?[A-Za-z_][A-Za-z0-9_]*(?:\.[A-Za-z_]\w*)?)|(?P<number>\d+)"
    r"|(?P<sign>:=|<=|>=|<>|[=<>+();:,\[\]]))"
)
_RANGE = {"Byte": 0xFF, "Word": 0xFFFF, "UInt": 0xFFFF, "DWord": 0xFFFFFFFF, "UDInt": 0xFFFFFFFF}
_CONVERSION = {
    "UINT_TO_WORD": ("UInt", "Word"), "WORD_TO_UINT": ("Word", "UInt"),
    "UDINT_TO_DWORD": ("UDInt", "DWord"), "DWORD_TO_UDINT": ("DWord", "UDInt"),
}  # fmt: skip
Type = str
Evaluate = Callable[["Block"], Any]


class SclError(Exception):
    """What TIA Portal would not compile, or a value that its type cannot hold."""


@dataclass
class Ton:
    """On-delay timer."""

    since_s: float | None = None
    q: bool = False

    def call(self, is_on: bool, preset_s: float, now_s: float) -> None:
        if not is_on:
            self.since_s, self.q = None, False
            return
        self.since_s = now_s if self.since_s is None else self.since_s
        self.q = now_s - self.since_s >= preset_s - 1e-6


@dataclass
class Block:
    """One instance of a function block; `scan` runs it once."""

    types: dict[str, Type]
    body: list[Callable[[Block], None]]
    structure: dict[str, Type]
    values: dict[str, Any] = field(default_factory=dict)
    db: dict[str, Any] = field(default_factory=dict)
    now_s: float = 0.0

    def __post_init__(self) -> None:
        for target, types in ((self.values, self.types), (self.db, self.structure)):
            target.update({name: _zero(kind) for name, kind in types.items() if not kind.startswith('"')})

    def scan(self, now_s: float, **inputs: Any) -> None:
        """One call with these inputs."""
        self.now_s = now_s
        for name, value in inputs.items():
            self.values[name] = _checked(value, self.types[name], name)
        for statement in self.body:
            statement(self)


def _zero(kind: Type) -> Any:
    return Ton() if kind == "TON_TIME" else False if kind == "Bool" else "" if kind.startswith("String") else 0


def _checked(value: Any, kind: Type, name: str) -> Any:
    if kind in _RANGE and not 0 <= value <= _RANGE[kind]:
        raise SclError(f"{name} : {kind} cannot hold {value}")
    if kind.startswith("String") and len(value) > int(kind[7:-1]):
        raise SclError(f"{name} : {kind} is too short for {value!r}")
    return value


def structure_of(udt: str) -> dict[str, Type]:
    """Members of the data type in their order, with fillers."""
    return dict(re.findall(r"^\s+(\w+) : ([\w\[\]]+);", udt, re.MULTILINE))


def offsets_of(udt: str) -> dict[str, tuple[int, int | None]]:
    """Where standard access puts each member (byte, bit), by the rules in the S7 manual."""
    found: dict[str, tuple[int, int | None]] = {}
    byte, bit = 0, 0
    sizes = {"Byte": 1, "Word": 2, "DWord": 4, "Real": 4}
    for name, kind in structure_of(udt).items():
        if kind == "Bool":
            found[name] = (byte, bit)
            byte, bit = (byte, bit + 1) if bit < 7 else (byte + 1, 0)
            continue
        size = sizes[kind] if kind in sizes else int(kind[7:-1]) + 2
        byte, bit = byte + (bit > 0), 0
        byte += byte % 2 if kind != "Byte" else 0
        found[name] = (byte, None)
        byte += size
    return found


class Parser:
    """Source text to a `Block`."""

    def __init__(self, source: str, udt: str) -> None:
        head, _, body = source.partition("\nBEGIN\n")
        self.types: dict[str, Type] = dict(re.findall(r"^\s+(\w+) : (\"?[\w\[\]]+\"?);", head, re.MULTILINE))
        self.structure = structure_of(udt)
        self.outputs = set(re.findall(r"(\w+) :", head.partition("VAR_OUTPUT")[2].partition("END_VAR")[0]))
        self.inputs = set(re.findall(r"(\w+) :", head.partition("VAR_INPUT")[2].partition("END_VAR")[0]))
        self._tokens = self._split(body.replace("END_FUNCTION_BLOCK", ""))
        self._at = 0

    def block(self) -> Block:
        """The whole function block.

        Raises:
            SclError: anything outside the subset, an unknown name, or types that do not fit.
        """
        return Block(self.types, self._statements(()), self.structure)

    def _split(self, text: str) -> list[str]:
        tokens, at = [], 0
        while text[at:].strip():
            match = _TOKEN.match(text, at)
            if match is None:
                raise SclError(f"cannot read {text[at : at + 30]!r}")
            at = match.end()
            if match.lastgroup != "note":
                tokens.append(match.group(match.lastgroup or 0))
        return tokens

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _take(self, wanted: str = "") -> str:
        token = self._peek()
        if not token or (wanted and token != wanted):
            raise SclError(f"expected {wanted or 'more'}, found {token or 'the end'}")
        self._at += 1
        return token

    def _statements(self, ends: tuple[str, ...]) -> list[Callable[[Block], None]]:
        found = []
        while self._peek() and self._peek() not in ends:
            found.append(self._if() if self._peek() == "IF" else self._simple())
        return found

    def _if(self) -> Callable[[Block], None]:
        branches: list[tuple[Evaluate, list[Callable[[Block], None]]]] = []
        otherwise: list[Callable[[Block], None]] = []
        word = self._take("IF")
        while word in ("IF", "ELSIF"):
            condition = self._expression("Bool")
            self._take("THEN")
            branches.append((condition, self._statements(("ELSIF", "ELSE", "END_IF"))))
            word = self._take()
        if word == "ELSE":
            otherwise = self._statements(("END_IF",))
            word = self._take()
        if word != "END_IF":
            raise SclError(f"expected END_IF, found {word}")
        self._take(";")

        def run(block: Block) -> None:
            for statement in next((body for condition, body in branches if condition(block)), otherwise):
                statement(block)

        return run

    def _simple(self) -> Callable[[Block], None]:
        name = self._take()
        if not name.startswith("#"):
            raise SclError(f"'{name}' begins no statement")
        if self._peek() == "(":
            return self._timer(name[1:])
        kind = self._type_of(name)
        if name[1:] in self.inputs:
            raise SclError(f"{name} is an input and is assigned to")
        self._take(":=")
        value = self._expression(kind)
        self._take(";")
        is_member, plain = name.startswith("#Wl."), name.removeprefix("#Wl.").removeprefix("#")

        def run(block: Block) -> None:
            (block.db if is_member else block.values)[plain] = _checked(value(block), kind, name)

        return run

    def _timer(self, name: str) -> Callable[[Block], None]:
        if self.types.get(name) != "TON_TIME":
            raise SclError(f"#{name} cannot be called")
        self._take("(")
        self._take("IN")
        self._take(":=")
        is_on = self._expression("Bool")
        self._take(",")
        self._take("PT")
        self._take(":=")
        text = self._take()
        preset_s = float(text[2:-2]) / 1000.0 if text.endswith("ms") else float(text[2:-1])
        self._take(")")
        self._take(";")
        return lambda block: block.values[name].call(is_on(block), preset_s, block.now_s)

    def _type_of(self, name: str) -> Type:
        if name.startswith("#Wl."):
            kind = self.structure.get(name[4:])
        elif name.endswith(".Q"):
            kind = "Bool" if self.types.get(name[1:-2]) == "TON_TIME" else None
        else:
            kind = self.types.get(name[1:])
        if kind is None:
            raise SclError(f"{name} is not declared")
        return kind

    def _expression(self, wanted: Type) -> Evaluate:
        kind, value = self._or()
        is_number = kind == "number" and wanted in ("UInt", "UDInt")
        is_text = kind.startswith("String") and wanted.startswith("String")
        if kind != wanted and not is_number and not is_text:
            raise SclError(f"expected {wanted}, found {kind} before token {self._at} {self._peek()}")
        return value

    def _or(self) -> tuple[Type, Evaluate]:
        return self._chain(self._and, {"OR": lambda a, b: a or b})

    def _and(self) -> tuple[Type, Evaluate]:
        return self._chain(self._not, {"AND": lambda a, b: a and b})

    def _chain(
        self, part: Callable[[], tuple[Type, Evaluate]], signs: dict[str, Callable[[Any, Any], Any]]
    ) -> tuple[Type, Evaluate]:
        kind, value = part()
        while self._peek() in signs:
            sign = signs[self._take()]
            other_kind, other = part()
            if {kind, other_kind} != {"Bool"}:
                raise SclError(f"AND and OR join Bool, not {kind} and {other_kind}")

            def both(block: Block, a: Evaluate = value, b: Evaluate = other, f: Callable[..., Any] = sign) -> Any:
                return f(a(block), b(block))

            value = both
        return kind, value

    def _not(self) -> tuple[Type, Evaluate]:
        if self._peek() != "NOT":
            return self._comparison()
        self._take()
        kind, value = self._not()
        if kind != "Bool":
            raise SclError(f"NOT wants Bool, not {kind}")
        return "Bool", lambda block: not value(block)

    def _comparison(self) -> tuple[Type, Evaluate]:
        kind, left = self._sum()
        signs: dict[str, Callable[[Any, Any], bool]] = {
            "=": lambda a, b: a == b, "<>": lambda a, b: a != b, ">=": lambda a, b: a >= b, "<=": lambda a, b: a <= b,
            "<": lambda a, b: a < b, ">": lambda a, b: a > b,
        }  # fmt: skip
        if self._peek() not in signs:
            return kind, left
        token = self._take()
        other, right = self._sum()
        texts = kind.startswith("String") and other.startswith("String")
        numbers = "number" in (kind, other) and {kind, other} - {"number"} <= {"UInt", "UDInt"}
        if kind != other and not texts and not numbers:
            raise SclError(f"{kind} and {other} do not compare")
        if kind in ("Word", "DWord", "Byte") and token not in ("=", "<>"):
            raise SclError(f"{kind} has no order")
        return "Bool", lambda block: signs[token](left(block), right(block))

    def _sum(self) -> tuple[Type, Evaluate]:
        kind, value = self._primary()
        while self._peek() == "+":
            self._take()
            other, term = self._primary()
            if kind not in ("UInt", "UDInt") or other not in (kind, "number"):
                raise SclError(f"{kind} + {other}")

            def both(block: Block, a: Evaluate = value, b: Evaluate = term) -> Any:
                return a(block) + b(block)

            value = both
        return kind, value

    def _primary(self) -> tuple[Type, Evaluate]:
        token = self._take()
        if token == "(":
            kind, value = self._or()
            self._take(")")
            return kind, value
        if token in ("TRUE", "FALSE"):
            return "Bool", lambda block: token == "TRUE"
        if token.isdigit():
            return "number", lambda block: int(token)
        if token in _CONVERSION:
            source, target = _CONVERSION[token]
            self._take("(")
            inner = self._expression(source)
            self._take(")")
            return target, inner
        if not token.startswith("#"):
            raise SclError(f"'{token}' is no value")
        kind = self._type_of(token)
        if token.startswith("#Wl."):
            return kind, lambda block: block.db[token[4:]]
        if token.endswith(".Q"):
            return kind, lambda block: block.values[token[1:-2]].q
        return kind, lambda block: block.values[token[1:]]

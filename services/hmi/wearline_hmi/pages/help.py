"""The help screen: what the signs, codes and rights mean."""

from __future__ import annotations

from nicegui.element import Element

from wearline.messages import CODE_MEANING, Decision
from wearline_hmi.core.rights import TABLE, Access, Item, Role
from wearline_hmi.core.words import decision_sign
from wearline_hmi.pages.frame import Frame
from wearline_hmi.pages.parts import Column, Rows, panel, sign_cell, text_element

DECISIONS = {
    Decision.PASSED: "The whole part was measured and lies within its limits. The PLC gets Passed.",
    Decision.FAILED: "A limit is exceeded for certain. The PLC gets Failed.",
    Decision.UNSURE: "Too near to a limit to be certain. The PLC gets Failed unless the recipe says other.",
    Decision.NOT_MEASURED: "The part could not be measured; the code says why. The PLC gets Failed.",
}
ACCESS = {
    Access.NONE: "No access", Access.OWN: "No access to others", Access.VIEW: "View only",
    Access.PART: "Part of parameters", Access.FULL: "Full access",
}  # fmt: skip
NOTES = (
    "What is old or unknown is grey, dashed or marked OLD, never green.",
    "Every value stands with its age. A service that is silent for six seconds is lost.",
    "Drag turns a part, the wheel zooms, the right button moves; with the keyboard arrow keys, plus, minus and Home.",
    "In the log and in production everything is searched on the server, also what is not shown.",
)


def build_help(page: Frame) -> None:
    """The screen ``/help``."""
    say = page.look.say
    with Element("div").classes("grid-settings"):
        with Element("div").classes("stack"):
            with panel(say("Verdicts")):
                Rows([Column("sign", say("Verdict")), Column("text", say("Meaning"))], say("Verdicts"), "").show(
                    [
                        {"id": d.value, "sign": sign_cell(decision_sign(d.value), say), "text": say(text)}
                        for d, text in DECISIONS.items()
                    ]
                )
            with panel(say("Good to know")), Element("div").classes("padded"):
                for note in NOTES:
                    text_element("p", say(note), "note")
            with panel(say("Rights")):
                columns = [Column("item", say("Item")), *(Column(role.value, say(role.value)) for role in Role)]
                Rows(columns, say("Rights"), "").show(
                    [
                        {
                            "id": item.value,
                            "item": say(item.value),
                            **{r.value: say(ACCESS[TABLE[item][r]]) for r in Role},
                        }
                        for item in Item
                    ]
                )
        with panel(say("Result codes")):
            Rows([Column("code", say("Code"), True), Column("text", say("Meaning"))], say("Result codes"), "").show(
                [{"id": str(int(c)), "code": str(int(c)), "text": say(text)} for c, text in CODE_MEANING.items()]
            )

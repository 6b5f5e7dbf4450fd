"""The result of a report in words: one sentence, and a further one for each qualification."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import takewhile

from torchrl_h2o.effects import Effect
from torchrl_h2o.effects.effect import EntryNames
from torchrl_h2o.residuals.progress import FORCES, NOISE
from torchrl_h2o.residuals.report.agreement import agreement_words, equal_joints_words
from torchrl_h2o.residuals.report.contents import (
    EXPLAINED_IN_PART,
    NOT_EXPLAINED,
    UNDECIDED,
    ReportContents,
    Verdict,
)
from torchrl_h2o.residuals.report.errors import ErrorSummary, HeadlineError
from torchrl_h2o.residuals.report.words import (
    change,
    duration,
    effect_name,
    effect_words,
    in_readable_unit,
    number,
    quantity,
)

MODEL_CHECK = "model"  # findings about the columns and the simulator
NAMED = 4  # undetectable effects that the sentence names
MIN_WORDS_ALIKE = 2  # words with which two phrases must begin to be put together
NOT_IN_CATALOGUE, NOT_SO_FAR = "this catalogue does not explain", "the search has not explained"


def sentence(report: ReportContents) -> str:
    """The result in words: the sentences of :func:`sentences`, joined."""
    return " ".join(sentences(report))


def sentences(report: ReportContents) -> list[str]:
    """The result in words, and what qualifies it.

    Returns:
        The result; whether the time was up before the end of the search, or of the report; other effects that these
        data cannot rule out; which values agree between logs, and their scatter between equal joints; effects that may
        have another cause or value; what the effects found do not explain; where nothing is missing, effects that the
        data could not have shown; and severe faults of the data, or warnings that the data do not fit the model. Those
        that do not apply are left out.
    """
    words = _verdict_words(report)
    if report.left_out:
        words.append(f"The time was up before these parts of the report were computed: {listed(report.left_out)}.")
    if report.audit is not None and report.audit.severe:
        faults = "; ".join(finding.words for finding in report.audit.severe)
        words.append(f"Do not rely on this: the data are faulty ({faults}).")
    elif report.audit is not None and report.found:
        doubts = "; ".join(finding.words for finding in report.audit.warnings if finding.check == MODEL_CHECK)
        if doubts:
            words.append(f"Check this first, because the effects found may stand for it: {doubts}.")
    return words


def _verdict_words(report: ReportContents) -> list[str]:
    if report.conclusion is not None:
        return [f"No conclusion: {report.conclusion.rstrip('. ')}."]
    if report.unfinished is not None:
        so_far = (
            f"so far the simulator lacks {listed(_found_words(report))}" if report.found else "nothing was found yet"
        )
        return [f"Unfinished, when {report.unfinished}: {so_far}."]
    error = _error_words(report.error) if report.error else ""
    words = listed(_found_words(report)) if report.found else ""
    kind, unknown = (None, "") if report.verdict is None else (report.verdict.kind, _unknown_words(report.verdict))
    by_what, ended = (
        (NOT_IN_CATALOGUE, []) if report.ended_in is None else (NOT_SO_FAR, [_ended_words(report.ended_in)])
    )
    if kind == NOT_EXPLAINED and report.verdict is not None and report.verdict.too_few:
        first = f"Something is missing, and these data do not tell what: {_joined(unknown, error)}."
        return [first, *ended, f"{report.verdict.too_few}."]
    if kind == NOT_EXPLAINED:
        attempt = words and f"the best attempt, {words}, is not recommended"
        return [f"Something is missing that {by_what}: {_joined(unknown, attempt, error)}.", *ended]
    if report.found:
        rest = [f"Something else is missing that {by_what}: {unknown}."] if unknown else []
        caveats = report.verdict.caveats if report.verdict is not None else ()
        lacks = "The best explanation so far" if report.preliminary else "Your simulator lacks"
        of_logs = [*agreement_words(report), *equal_joints_words(report)]
        return [f"{lacks}: {_joined(words, error)}.", *ended, *_alternatives_words(report), *of_logs, *caveats, *rest]
    if kind == UNDECIDED:
        reasons = (report.verdict and report.verdict.reasons) or ("no test shows that something is missing",)
        return [f"{_joined(f'Nothing was found so far, and {reasons[0]}', error)}.", *ended]
    nothing = f"Nothing is missing: {_joined('the effects tried explain no more than chance', error)}."
    return [nothing, *_undetectable_words(report.verdict)]


def _ended_words(stage: str) -> str:
    """What the search has not done because its time was up."""
    if stage in (FORCES, NOISE):
        left = "a force outside the catalogue, and action noise, were" if stage == FORCES else "action noise was"
        return f"The time for the search was up: {left} not looked for."
    return (
        f"The time for the search was up while it was {stage}: effects may still be added or replaced, and others may "
        "explain these data as well."
    )


def _undetectable_words(verdict: Verdict | None) -> list[str]:
    """Effects that the data could not have shown, in up to one sentence."""
    effects = () if verdict is None else verdict.undetectable
    if not effects:
        return []
    named = listed(effects[:NAMED])
    if len(effects) <= NAMED:
        return [f"Not identifiable in these data, because noise or a lack of motion would hide them: {named}."]
    hidden = f"{len(effects)} effects are not identifiable in these data, because noise or a lack of motion would hide"
    return [f"{hidden} them, such as {named}."]


def _unknown_words(verdict: Verdict) -> str:
    """Why something is missing and where it shows; empty if the effects found explain everything."""
    if verdict.kind not in (EXPLAINED_IN_PART, NOT_EXPLAINED):
        return ""
    return _joined(*verdict.reasons, verdict.where and f"it shows {verdict.where}")


def _joined(*parts: str) -> str:
    return "; ".join(part for part in parts if part)


def _found_words(report: ReportContents) -> list[str]:
    """The effects found; those of one kind are named together."""
    return _by_kind((found.effect, found.words) for found in report.found)


def effects_in_words(effects: Sequence[Effect], names: EntryNames) -> str:
    """A list of effects with their values; those of one kind are named together."""
    return listed(_by_kind((effect, effect_words(effect, names)) for effect in effects))


def _by_kind(pairs: Iterable[tuple[Effect, str]]) -> list[str]:
    kinds: dict[type, list[str]] = {}
    for effect, words in pairs:
        kinds.setdefault(type(effect), []).append(words)
    return [words for alike in kinds.values() for words in together(alike)]


def together(words: Sequence[str]) -> list[str]:
    """Effects of one kind in one phrase, if their words begin alike.

    Examples:
        >>> together(["dry friction of joints hip + 0.27 N·m", "dry friction of joints knee + 0.88 N·m"])
        ['dry friction of joints hip + 0.27 and knee + 0.88 N·m']
    """
    split = [phrase.split() for phrase in words]
    first = _num_alike(split)
    last = _num_alike([phrase[:first:-1] for phrase in split])
    if len(words) < 2 or first < MIN_WORDS_ALIKE:
        return list(words)
    middle = [" ".join(phrase[first : len(phrase) - last]) for phrase in split]
    return [" ".join([*split[0][:first], listed(middle), *split[0][len(split[0]) - last :]])]


def _num_alike(phrases: Sequence[Sequence[str]]) -> int:
    """Number of words with which all phrases begin."""
    return len(list(takewhile(lambda column: len(set(column)) == 1, zip(*phrases, strict=False))))


def _alternatives_words(report: ReportContents) -> list[str]:
    """Other effects, and other sets of effects, that these data cannot rule out, in up to two sentences."""
    others = {effect_name(group.effects[0]): group.words[1:] for group in report.indistinguishable}
    pairs = [
        f"{found.words} from {_one_or_count(others[found.name])}" for found in report.found if others.get(found.name)
    ]
    words = [f"These data cannot tell {', nor '.join(pairs)}."] if pairs else []
    if report.others:
        first, more = listed(report.others[0].words), len(report.others) > 1
        sets = f"{len(report.others)} other sets of effects explain" if more else "Another set of effects explains"
        words.append(f"{sets} these data as well{', such as' if more else ':'} {first}.")
    return words


def _one_or_count(others: Sequence[str]) -> str:
    return others[0] if len(others) == 1 else f"{len(others)} other effects"


def listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]


def _error_words(error: ErrorSummary) -> str:
    if error.headline is not None:
        return headline_words(error.headline)
    if not (math.isfinite(error.before) and math.isfinite(error.after)):
        return ""
    floor = "" if number(error.floor) == "–" else f", floor {number(error.floor, 2)}"
    if error.after == error.before:
        return f"one-step error {quantity(error.after, error.unit, 2)}{floor}"
    percent = change(error.before, error.after)
    percent = f" ({percent})" if percent else ""
    return f"one-step error {number(error.before, 2)} → {quantity(error.after, error.unit, 2)}{percent}{floor}"


def headline_words(error: HeadlineError) -> str:
    """The error of one quantity some time ahead, in words.

    Examples:
        >>> headline_words(HeadlineError("elbow", "rad", 0.1, before=0.074, after=0.014))
        'elbow 100 ms ahead: 74 → 14 mrad (−81 %)'
    """
    what = f"{error.name} {duration(error.seconds)} ahead"
    unit, (before, after) = in_readable_unit(error.unit, error.before, error.after)
    if error.after == error.before:
        return f"{what}: error {quantity(after, unit, 2)}"
    percent = change(before, after)
    return f"{what}: {number(before, 2)} → {quantity(after, unit, 2)}{percent and f' ({percent})'}"

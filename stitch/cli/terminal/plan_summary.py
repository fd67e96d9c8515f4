"""What `stitch plan` says: U of the hand-eye, chances of every effect, pairs that stay alike, further views."""

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from stitch.model.hand_eye_uncertainty import expanded_uncertainty
from stitch.planning.expected_hand_eye import ExpectedHandEye
from stitch.planning.expected_model import CellModel
from stitch.planning.outlook import EffectOutlook, Outlook
from stitch.planning.plan import Plan
from stitch.planning.rivals import EffectPair
from stitch.system.console import console
from stitch.units import METRES, format_amount, length_text, uncertainty_text

# Pairs that are shown, and the share of wrong names from which they are told.
_PAIRS, _MISTAKEN = 3, 0.05


def show_plan(plan: Plan, cell: CellModel, output: Path | None) -> None:
    """For people, on standard error."""
    terminal = console()
    if plan.assumed:
        terminal.print(f"Nobody stated, so assumed: {'; '.join(plan.assumed)}.", soft_wrap=True)
    if plan.now is None:
        terminal.print("Fewer than three views give no hand-eye; views are proposed.", soft_wrap=True)
    else:
        _show_outlook(terminal, plan, plan.now, cell)
    _show_proposed(terminal, plan)
    if plan.after is not None:
        if plan.now is None:
            _show_outlook(terminal, plan, plan.after, cell)
        else:
            _show_after(terminal, plan, plan.now, plan.after)
    if output is not None:
        terminal.print(f"  {output / 'views.csv' if plan.proposed else output / 'plan.json'}", soft_wrap=True)


def _show_outlook(terminal: Console, plan: Plan, o: Outlook, cell: CellModel) -> None:
    unit, frame = plan.session.length_unit, "base" if plan.session.mount == "eye_to_hand" else "flange"
    terminal.print(f"What {o.views} views would tell:", style="bold", soft_wrap=True)
    terminal.print(f"U (k = 2) of the hand-eye T_{frame}_scanner, in the frame of the {frame}:", soft_wrap=True)
    U = expanded_uncertainty(cell.model.T_mount, o.hand_eye.covariance) * np.repeat([1e3, METRES[unit] * 1e3], 3)
    position, turn = (", ".join(map(_axis_text, "xyz", sizes)) for sizes in (U[3:], U[:3]))
    terminal.print(f"  position {position} mm", soft_wrap=True)
    terminal.print(f"  rotation vector {turn} mrad", soft_wrap=True)
    terminal.print(
        f"  at the part {length_text(o.hand_eye.U, unit, 2)}, mostly {_source_shares(o.hand_eye)}; "
        f"{length_text(o.ordinary.U, unit, 2)} with an arm that is a little wrong in every joint and link",
        soft_wrap=True,
    )
    table = Table(title="Of an effect of usual size", title_justify="left")
    for heading in ("effect", "detected from", "detected", "named", "misnamed"):
        table.add_column(heading, justify="left" if heading == "effect" else "right", no_wrap=True)
    for e in o.effects:
        if e.chance is not None:
            c = e.chance
            table.add_row(e.name, _detectable_text(e), f"{c.detected:.0%}", f"{c.named:.0%}", f"{c.misnamed:.0%}")
    terminal.print(table)
    mistaken = [e.chance for e in o.effects if e.chance is not None and e.chance.misnamed >= _MISTAKEN]
    for c in mistaken:
        terminal.print(f"{c.effect} would be taken for {c.taken_for} most often.", soft_wrap=True)
    unseen = [e.name for e in o.effects if not e.observable]
    if unseen:
        terminal.print(f"These views cannot show: {', '.join(unseen)}.", soft_wrap=True)
    for need in sorted({need for needs in o.untestable.values() for need in needs}):
        names = ", ".join(name for name, needs in o.untestable.items() if need in needs)
        terminal.print(f"Not asked without {need}: {names}.", soft_wrap=True)
    _show_pairs(terminal, o)


def _axis_text(axis: str, U: float) -> str:
    return f"{axis} {uncertainty_text(U)}"


def _source_shares(hand_eye: ExpectedHandEye) -> str:
    shares = sorted(hand_eye.shares.items(), key=lambda item: -item[1])[:2]
    return " and ".join(f"{name} ({share:.0%})" for name, share in shares)


def _detectable_text(e: EffectOutlook) -> str:
    """The parameter that shows best, at its smallest detectable size."""
    if not e.detectable:
        return "–"
    name = min(e.detectable, key=lambda name: e.detectable[name] / e.usual[name])
    told = format_amount(e.detectable[name], e.detectable[name] / 10, e.units[name])
    return f"{name} {told._replace(sigma='–')}"


def _show_pairs(terminal: Console, o: Outlook) -> None:
    """Pairs that are not told apart at usual size, or the hardest one."""
    hard = [pair for pair in o.pairs if pair.size > 1][:_PAIRS] or list(o.pairs[:1])
    for pair in hard:
        own, rival, size = (pair.a, pair.b, pair.size_a) if pair.size_a > pair.size_b else (pair.b, pair.a, pair.size_b)
        terminal.print(f"{own} is told from {rival} {_multiple_text(size)}.", soft_wrap=True)


def _show_proposed(terminal: Console, plan: Plan) -> None:
    if not plan.proposed:
        terminal.print(f"Nothing is proposed: {_no_views_reason(plan)}.", soft_wrap=True)
        return
    unit = plan.session.length_unit
    title = "Further views" + ("" if plan.split is None else f" (to tell {' from '.join(plan.split)})")
    table = Table(title=title, title_justify="left")
    table.add_column("view")
    for heading in ("joints °", "travel °", "U at the part", "told apart"):
        table.add_column(heading, justify="right", no_wrap=True)
    for view in plan.proposed:
        joints = " ".join(f"{x:.0f}" for x in np.degrees(view.joints))
        apart = f"{view.separated_share:.0%}" if np.isfinite(view.separated_share) else "–"
        travel = f"{np.degrees(view.travel):.0f}"
        table.add_row(view.name, joints, travel, length_text(view.U, unit, 2, zeros=True), apart)
    terminal.print(table)


def _no_views_reason(plan: Plan) -> str:
    if plan.session.robot is None or plan.session.joints is None:
        return "that needs [robot] in session.toml, and joint angles of all views"
    own = None if plan.split is None or plan.now is None else _find_pair(plan.now, plan.split)
    if own is not None and own.size <= 1:
        return f"at usual size these views tell {own.a} from {own.b} as they are"
    return "no pose within reach brings more"


def _show_after(terminal: Console, plan: Plan, now: Outlook, after: Outlook) -> None:
    unit = plan.session.length_unit
    terminal.print(
        f"With them U of the hand-eye at the part goes from {length_text(now.hand_eye.U, unit, 2)} to "
        f"{length_text(after.hand_eye.U, unit, 2)}; what is left is mostly {_source_shares(after.hand_eye)}.",
        soft_wrap=True,
    )
    if plan.split is not None:
        before, then = (_find_pair(o, plan.split) for o in (now, after))
        if before is not None and then is not None:
            names = " and ".join(plan.split)
            terminal.print(
                f"{names} are told apart {_multiple_text(then.size)}; now {_multiple_text(before.size)}.",
                soft_wrap=True,
            )


def _multiple_text(size: float) -> str:
    return f"from {size:.2g} times its usual size" if np.isfinite(size) else "at no size"


def _find_pair(o: Outlook, names: tuple[str, str]) -> EffectPair | None:
    return next((p for p in o.pairs if {p.a, p.b} == set(names)), None)

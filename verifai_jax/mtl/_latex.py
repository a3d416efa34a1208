r"""Formulas in LaTeX.

latex(eventually(signal("x") <= 2, 0, 4))    # \Diamond_{[0, 4]} \left(\mathit{x} \leq 2\right)
"""

from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import PRECEDENCE, Arithmetic, Component, Number, Signal
from verifai_jax.mtl.formula import Formula, Term, surface
from verifai_jax.mtl.sampled import Sampled, window_text
from verifai_jax.mtl.tree import missing_case
from verifai_jax.mtl.words import COMPARISONS, OPERATORS, number_text


def latex(f: Formula) -> str:
    """Write a formula in LaTeX math mode; its temporal symbols need `amssymb`."""
    match f:
        case ast.Constant(value):
            return r"\top" if value else r"\bot"
        case ast.Predicate(comparison, left, right):
            symbol = COMPARISONS[comparison].latex
            return f"{_expression_latex(left)} {symbol} {_expression_latex(right)}"
        case ast.Atom(e):
            return _expression_latex(e)
    word, operands, interval = surface(f)
    symbol = OPERATORS[word].latex
    if interval is not None and not interval.everything:
        end = r"\infty" if interval.end == float("inf") else number_text(interval.end)
        left, right = "[("[interval.open_start], "])"[interval.open_end]
        symbol += f"_{{{left}{number_text(interval.start)}, {end}{right}}}"
    parts = [
        latex(p) if not p.operands() and len(operands) > 1 else rf"\left({latex(p)}\right)"
        for p in operands
    ]
    return f"{symbol} {parts[0]}" if len(parts) == 1 else f" {symbol} ".join(parts)


def _expression_latex(e: Term, outer: int = 0) -> str:
    if e.opened:
        text = str(e).replace("_", r"\_").replace("%", r"\%")
        return rf"\mathrm{{{text}}}"
    match e:
        case Number(value):
            return f"({number_text(value)})" if value < 0 and outer > 0 else number_text(value)
        case Sampled(_, operands, window):
            below = "" if window is None else f"_{{{window_text(window)}}}"
            word = e.function.replace("_", r"\_")
            texts = (latex(o) if isinstance(o, Formula) else _expression_latex(o) for o in operands)
            return rf"\mathrm{{{word}}}{below}\left({', '.join(texts)}\right)"
        case Signal(name):
            return rf"\mathit{{{name.replace('_', chr(92) + '_')}}}"
        case Component(vector, index):
            return f"{_expression_latex(vector)}_{{{index}}}"
        case Arithmetic("neg", (argument,)):
            level, text = 3, f"-{_expression_latex(argument, 4)}"
        case Arithmetic("/", (left, right)):
            return rf"\frac{{{_expression_latex(left)}}}{{{_expression_latex(right)}}}"
        case Arithmetic("**", (base, exponent)):
            level, text = 4, _expression_latex(base, 5)
            if isinstance(base, Arithmetic) and base.name == "/":
                text = rf"\left({text}\right)"  # No fraction is a base without them.
            text = f"{text}^{{{_expression_latex(exponent)}}}"
        case Arithmetic("+" | "-" | "*" as name):
            level = PRECEDENCE[name]
            # In a loop: a sum of many terms leans to the left as deep as it is long.
            pieces: list[str] = []
            while isinstance(e, Arithmetic) and e.name != "/" and PRECEDENCE.get(e.name) == level:
                symbol = r"\cdot" if e.name == "*" else e.name
                pieces.append(f" {symbol} {_expression_latex(e.arguments[1], level + 1)}")
                e = e.arguments[0]
            text = "".join([_expression_latex(e, level), *reversed(pieces)])
        case Arithmetic("abs", (argument,)):
            return rf"\left|{_expression_latex(argument)}\right|"
        case Arithmetic("norm", (argument,)):
            return rf"\left\lVert{_expression_latex(argument)}\right\rVert"
        case Arithmetic("sqrt", (argument,)):
            return rf"\sqrt{{{_expression_latex(argument)}}}"
        case Arithmetic(name, arguments):
            return rf"\{name}\left({', '.join(map(_expression_latex, arguments))}\right)"
        case _:
            raise missing_case("the LaTeX", e)
    return rf"\left({text}\right)" if level < outer else text

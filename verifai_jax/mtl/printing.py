"""The text of a formula, which parses back to the same formula.

    show(always(signal("x") <= 2, 0, 4))              # 'always[0,4] (x <= 2)'
    show((signal("x") > 1) >> (signal("y") > 0))      # 'x > 1 -> y > 0'
    latex(eventually(signal("x") <= 2, 0, 4))

Sugar that was rewritten away (`->`, `<->`, `^`, weak until, release) is recognised and restored.
"""

import re

from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.formula import Expression, Formula, Interval

NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")

#: Every word and symbol of the text grammar, by the operator it stands for.
WORDS: dict[str, tuple[str, ...]] = {
    "always": ("always", "alw", "G", "[]"),
    "eventually": ("eventually", "ev", "F", "<>"),
    "historically": ("historically", "hist", "H"),
    "once": ("once", "O"),
    "next": ("next", "X", "@"),
    "prev": ("prev", "Y"),
    "weak_prev": ("weak_prev",),
    "until": ("until", "U"),
    "weak_until": ("weak_until", "unless", "W"),
    "release": ("release", "R"),
    "since": ("since", "S"),
    "not": ("not", "!", "~"),
    "and": ("and", "&&", "&"),
    "or": ("or", "||", "|"),
    "implies": ("implies", "->", "=>"),
    "iff": ("iff", "<->"),
    "xor": ("xor", "^"),
    "TRUE": ("TRUE", "True", "true"),
    "FALSE": ("FALSE", "False", "false"),
}

RESERVED = frozenset(w for words in WORDS.values() for w in words if NAME.fullmatch(w))

_PRECEDENCE = {"+": 1, "-": 1, "*": 2, "/": 2, "neg": 3}


def show_number(value: float) -> str:
    """The shortest text that reads back as the same float; `inf` for infinity."""
    return str(int(value)) if abs(value) < 1e16 and value == int(value) else repr(value)


def show_name(name: str) -> str:
    """A signal's name, quoted where the grammar would not take it bare."""
    bare = NAME.fullmatch(name) and name not in RESERVED and name not in ast.FUNCTIONS
    return name if bare else f'"{name}"'


def show_expression(e: Expression, outer: int = 0) -> str:
    """The text of an expression, in parentheses if its operator binds weaker than `outer`."""
    match e:
        case ast.Number(value):
            return f"({show_number(value)})" if value < 0 and outer > 0 else show_number(value)
        case ast.Signal(name):
            return show_name(name)
        case ast.Component(vector, index):
            return f"{show_expression(vector)}[{index}]"
        case ast.Arithmetic("neg", (argument,)):
            level = _PRECEDENCE["neg"]
            text = f"-{show_expression(argument, level + 1)}"
        case ast.Arithmetic(("+" | "-" | "*" | "/") as name, (left, right)):
            level = _PRECEDENCE[name]
            text = f"{show_expression(left, level)} {name} {show_expression(right, level + 1)}"
        case ast.Arithmetic(name, arguments):
            return f"{name}({', '.join(map(show_expression, arguments))})"
        case _:
            raise TypeError(f"not an expression: {e!r}")
    return f"({text})" if level < outer else text


def sugared(f: Formula) -> tuple[str, tuple[Formula, ...], Interval | None]:
    """How the formula reads: its operator's word, the operands, and the interval if it has one."""
    match f:
        case ast.Not(ast.Or((ast.And((p, q)), ast.And((ast.Not(r), ast.Not(s)))))) if (
            p == r and q == s
        ):
            return "xor", (p, q), None
        case ast.Not(ast.Until(ast.Not(p), ast.Not(q), interval)):
            return "release", (p, q), interval
        case ast.Or((ast.And((p, q)), ast.And((ast.Not(r), ast.Not(s))))) if p == r and q == s:
            return "iff", (p, q), None
        case ast.Or((ast.Until(p, q, interval), ast.Always(r, ast.Interval(0.0, end)))) if (
            p == r and end == interval.end
        ):
            return "weak_until", (p, q), interval
        case ast.Or((ast.Not(p), q)):
            return "implies", (p, q), None
        case ast.Not(p):
            return "not", (p,), None
        case ast.And(parts):
            return "and", parts, None
        case ast.Or(parts):
            return "or", parts, None
        case ast.Next(p):
            return "next", (p,), None
        case ast.Prev(p, weak):
            return "weak_prev" if weak else "prev", (p,), None
        case ast.Until(p, q, interval):
            return "until", (p, q), interval
        case ast.Since(p, q, interval):
            return "since", (p, q), interval
        case (
            ast.Always(p, interval)
            | ast.Eventually(p, interval)
            | ast.Historically(p, interval)
            | ast.Once(p, interval)
        ):
            return type(f).__name__.lower(), (p,), interval
    raise TypeError(f"not an operator: {f!r}")


def show(f: Formula) -> str:
    """The text of a formula; `parse(show(f)) == f`."""
    match f:
        case ast.Constant(value):
            return "TRUE" if value else "FALSE"
        case ast.Predicate(comparison, left, right):
            return f"{show_expression(left)} {comparison} {show_expression(right)}"
        case ast.Atom(e):
            return show_expression(e)
    word, operands, interval = sugared(f)
    span = "" if interval is None or interval.everything else str(interval)
    if word in ("and", "or", "implies", "iff", "xor"):
        symbol = {"and": "&", "or": "|", "implies": "->", "iff": "<->", "xor": "^"}[word]
        texts = [show(p) if _is_leaf(p) or _is_negation(p) else f"({show(p)})" for p in operands]
        if word == "implies" and len(_operator(operands[1])) == 1:
            texts[1] = show(operands[1])
        return f" {symbol} ".join(texts)
    if word == "not":
        return f"!{_wrapped(operands[0])}"
    if len(operands) == 1:
        operand = operands[0]
        chain = len(_operator(operand)) == 1
        return f"{word}{span} {show(operand) if chain else _wrapped(operand)}"
    left, right = operands
    return f"{_wrapped(left)} {word}{span} {_wrapped(right)}"


def _is_leaf(f: Formula) -> bool:
    return isinstance(f, (ast.Constant, ast.Predicate, ast.Atom))


def _operator(f: Formula) -> tuple[Formula, ...]:
    """The operands as it reads; none for a leaf."""
    return () if _is_leaf(f) else sugared(f)[1]


def _is_negation(f: Formula) -> bool:
    return not _is_leaf(f) and sugared(f)[0] == "not"


def _wrapped(f: Formula) -> str:
    simple = isinstance(f, ast.Constant) or (
        isinstance(f, ast.Atom) and isinstance(f.expression, (ast.Signal, ast.Component))
    )
    return show(f) if simple else f"({show(f)})"


_LATEX = {
    "and": r"\land", "or": r"\lor", "implies": r"\rightarrow", "iff": r"\leftrightarrow",
    "xor": r"\oplus", "not": r"\lnot", "always": r"\Box", "eventually": r"\Diamond",
    "historically": r"\boxminus", "once": r"\diamondminus", "next": r"\bigcirc",
    "prev": r"\ominus", "weak_prev": r"\widetilde{\ominus}",
    "until": r"\mathbin{\mathcal{U}}", "since": r"\mathbin{\mathcal{S}}",
    "weak_until": r"\mathbin{\mathcal{W}}", "release": r"\mathbin{\mathcal{R}}",
}  # fmt: skip

_COMPARISON_LATEX = {">=": r"\geq", "<=": r"\leq", "==": "=", "!=": r"\neq"}


def latex(f: Formula) -> str:
    """The formula in LaTeX math mode (needs `amssymb` for the temporal symbols)."""
    match f:
        case ast.Constant(value):
            return r"\top" if value else r"\bot"
        case ast.Predicate(comparison, left, right):
            symbol = _COMPARISON_LATEX.get(comparison, comparison)
            return f"{_expression_latex(left)} {symbol} {_expression_latex(right)}"
        case ast.Atom(e):
            return _expression_latex(e)
    word, operands, interval = sugared(f)
    symbol = _LATEX[word]
    if interval is not None and not interval.everything:
        end = r"\infty" if interval.end == float("inf") else show_number(interval.end)
        symbol += f"_{{[{show_number(interval.start)}, {end}]}}"
    parts = [
        latex(p) if _is_leaf(p) and len(operands) > 1 else rf"\left({latex(p)}\right)"
        for p in operands
    ]
    return f"{symbol} {parts[0]}" if len(parts) == 1 else f" {symbol} ".join(parts)


def _expression_latex(e: Expression, outer: int = 0) -> str:
    match e:
        case ast.Number(value):
            return f"({show_number(value)})" if value < 0 and outer > 0 else show_number(value)
        case ast.Signal(name):
            return rf"\mathit{{{name.replace('_', chr(92) + '_')}}}"
        case ast.Component(vector, index):
            return f"{_expression_latex(vector)}_{{{index}}}"
        case ast.Arithmetic("neg", (argument,)):
            level, text = 3, f"-{_expression_latex(argument, 4)}"
        case ast.Arithmetic("/", (left, right)):
            return rf"\frac{{{_expression_latex(left)}}}{{{_expression_latex(right)}}}"
        case ast.Arithmetic(("+" | "-" | "*") as name, (left, right)):
            level = _PRECEDENCE[name]
            symbol = r"\cdot" if name == "*" else name
            right = _expression_latex(right, level + 1)
            text = f"{_expression_latex(left, level)} {symbol} {right}"
        case ast.Arithmetic("abs", (argument,)):
            return rf"\left|{_expression_latex(argument)}\right|"
        case ast.Arithmetic("norm", (argument,)):
            return rf"\left\lVert{_expression_latex(argument)}\right\rVert"
        case ast.Arithmetic("sqrt", (argument,)):
            return rf"\sqrt{{{_expression_latex(argument)}}}"
        case ast.Arithmetic(name, arguments):
            return rf"\{name}\left({', '.join(map(_expression_latex, arguments))}\right)"
        case _:
            raise TypeError(f"not an expression: {e!r}")
    return rf"\left({text}\right)" if level < outer else text

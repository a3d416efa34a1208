"""The text of formulas: what parses, what it means, and the wording of every refusal."""

import math
import pickle

import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.core.messages.text import format_seconds
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import (
    FALSE,
    TRUE,
    FormulaSyntaxError,
    always,
    eventually,
    historically,
    latex,
    next_,
    nnf,
    once,
    parse,
    prev,
    robustness,
    signal,
    simplify,
    since,
    until,
)
from verifai_jax.mtl.expression import expression

X, Y, A, B = signal("x"), signal("y"), signal("a"), signal("b")


@pytest.mark.parametrize(
    ("text", "formula"),
    [
        ("x > 1", X > 1),
        ("abs(x) <= 2.4 & abs(y) <= .5", (abs(X) <= 2.4) & (Y.abs() <= 0.5)),
        ("always[0, 4] (x > 1)", always(X > 1, 0, 4)),
        ("G[0:4] x > 1", always(X > 1, 0, 4)),
        ("[] <> a", always(eventually(A))),
        ("alw_[0,10] (a => ev_[0,500ms] b)", always(A >> eventually(B, 0, 0.5), 0, 10)),
        ("F[1min, inf] a", eventually(A, 60)),
        ("F[250us,1ms] a", eventually(A, 0.00025, 0.001)),
        ("H[0,3](x >= 0) & (a S[2,6] b)", historically(X >= 0, 0, 3) & since(A, B, 2, 6)),
        ("O a | hist b", once(A) | historically(B)),
        ("X Y a", next_(prev(A))),
        ("@ weak_prev a", next_(prev(A, weak=True))),
        ("a U[0.2,0.6] b", until(A, B, 0.2, 0.6)),
        ("a unless b", until(A, B) | always(A)),
        ("a R b", ~until(~A, ~B)),
        ("a <-> !b", always(A).operand.iff(~B)),
        ("a xor b", always(A).operand ^ B),
        ("a -> b and x < 3", A >> ((always(B).operand) & (X < 3))),
        ("min(x, y, 1) / 4 > -x + 2*y - -3", X.min(Y, 1) / 4 > -X + 2 * Y - (-3)),
        ("norm(p) > 1 & p[1] < 2", (signal("p").norm() > 1) & (signal("p")[1] < 2)),
        ("sqrt(x) + sin(x) != cos(x)", (X.sqrt() + X.sin()).differs(X.cos())),
        ("TRUE & !FALSE", TRUE & ~FALSE),
        ("x**2 + y ** 2 < 1", X**2 + Y**2 < 1),
        ("-x**2 > 2**-y * 3", -(X**2) > 2 ** (-Y) * 3),
        ("p[0]**2 / abs(x)**0.5 < (x - 1)**3", signal("p")[0] ** 2 / abs(X) ** 0.5 < (X - 1) ** 3),
        ("a ^ b", always(A).operand ^ B),
        ("(x > 0) ^ (y > 0)", (X > 0) ^ (Y > 0)),
        ("x > 0 ^ y > 0", (X > 0) ^ (Y > 0)),
        ("!a ^ always b", ~A ^ always(B)),
        ('"ego speed [m/s]" > 2', signal("ego speed [m/s]") > 2),
        ("ego.speed > 2", signal("ego.speed") > 2),
        ("s > 1 & ms < 2", (signal("s") > 1) & (signal("ms") < 2)),
        ("Gain > 0 & untilted", (signal("Gain") > 0) & signal("untilted")),
        ("1e-3 < x & .5e1 > y", parse("0.001 < x & 5 > y")),
        ("2 * pi > x", 2 * expression(math.pi) > X),
    ],
)
def test_a_text_is_read_as_its_formula(text, formula):
    parsed = parse(text)
    assert parsed == formula
    assert parse(str(parsed)) == parsed


def test_an_angle_or_a_time_is_a_number_in_rad_or_seconds():
    f = parse('x < 90deg & deg > 1 deg & "pi" > 2rad & x < 2 ms')
    numbers = [leaf.terms()[1].number for leaf in f.operands()]
    assert numbers == [math.pi / 2, math.pi / 180, 2.0, 0.002]
    assert parse(str(f)) == f


@pytest.mark.parametrize(
    ("formula", "text"),
    [
        (always((abs(X) <= 2.4) & (Y > 0), 0, 4), "always[0,4] (abs(x) <= 2.4 & y > 0)"),
        (
            always((X > 1) >> eventually(Y > 0, 0, 0.5)),
            "always (x > 1 -> eventually[0,0.5] (y > 0))",
        ),
        (until(X > 0, Y > 0, 1, 2), "(x > 0) until[1,2] (y > 0)"),
        ((X > 0).weak_until(Y > 0), "(x > 0) weak_until (y > 0)"),
        ((X > 0).release(Y > 0), "(x > 0) release (y > 0)"),
        ((X > 0).iff(Y > 0), "x > 0 <-> y > 0"),
        ((X > 0) ^ (Y > 0), "x > 0 xor y > 0"),
        (A ^ (Y > 0), "a xor y > 0"),
        (-(X**2) < (-X) ** 2, "-x**2 < (-x)**2"),
        ((2 * expression(math.pi) > X) & (-math.pi <= X), "2 * pi > x & x >= -pi"),
        (X - expression(-math.pi) < math.pi / 4, "x - (-pi) < 0.7853981633974483"),
        ((X**2) ** 3 > X ** (Y**2), "(x**2)**3 > x**(y**2)"),
        ((X * Y) ** -2 > (X / Y) ** (Y + 1), "(x * y)**(-2) > (x / y)**(y + 1)"),
        (X.sqrt() ** 2 < (X * 0 - 2) ** 2, "sqrt(x)**2 < (x * 0 - 2)**2"),
        (X - (Y - 1) > -2, "x - (y - 1) > -2"),
        (signal("G") > 0, '"G" > 0'),
        (signal("a b") > 0, '"a b" > 0'),
    ],
)
def test_a_formula_is_written_so_that_it_is_read_again(formula, text):
    assert str(formula) == text
    assert parse(text) == formula


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a -> b -> c", "a chain of '->' is ambiguous: write a -> (b -> c) or (a -> b) -> c"),
        ("a U b U c", "a chain of 'U' is ambiguous: write a U (b U c) or (a U b) U c"),
        ("a <-> b <-> c", "a chain of '<->' is ambiguous"),
        (
            "always a and b",
            "the scope of 'always' is ambiguous: write always (a and b) or (always a) and b",
        ),
        ("always x > 1 -> b", "write always (x > 1 -> b) or (always x > 1) -> b"),
        (
            "a U b & c",
            "until and its like next to '&' is ambiguous: put it in parentheses, as in (a U b)",
        ),
        ("a | b S c", "next to '|' is ambiguous: put it in parentheses, as in (b S c)"),
        ("G[3,1] a", "an interval ends no earlier than it starts: write [1, 3]"),
        ("G[-1,2] a", "an interval starts at 0 or later"),
        ("G[inf,inf] a", "an interval starts at a finite time"),
        ("G[a,2] x", "unknown constant 'a'"),
        ("next[0,2] a", "'next' takes no interval"),
        ("x >", "expected a signal or a number or '(', but found the end of the text"),
        ("(x > 1", "expected ')', but found the end of the text"),
        ("x > 1)", "there is no '(' for this ')'"),
        ("a & & b", "but found '&'"),
        ("x = 1", "'=' is not a comparison: write == for equal, >= or <="),
        ("0 < x < 1", "comparisons do not chain: write (0 < x) & (x < 1)"),
        ("G[0,2 a", "expected a unit (s, ms, us, ns, min, h, d), ')' or ']', but found 'a'"),
        ("G[0] a", "expected ',' or ':', but found ']'"),
        ("x ? 1", "but found '?'"),
        ("foo(x) > 1", "unknown function 'foo'"),
        ("sqr(x) > 1", "did you mean 'sqrt'?"),
        ("abs(x, y) > 1", "abs takes one argument; got 2"),
        ("min(x) > 1", "min takes two arguments or more; got 1"),
        ("(a & b) + 1 > 2", "a number or a signal is needed here, not the formula '(a & b)'"),
        ("abs(a & b) > 2", "a number or a signal is needed here, not the formula 'a & b'"),
        ("3", "not the number 3: compare a signal with it, as in x > 3, or write TRUE or FALSE"),
        ("always (1 + 2)", "a formula is needed here, not the number 1 + 2"),
        ("2 < 0.5", "2 < 0.5 compares numbers but no signal"),
        ("a & 2 < 0.5", "compare a signal, as in x < 0.5, or write TRUE or FALSE"),
        (
            "always (x^2 < 0.5)",
            "next to arithmetic: a power is written x**2, and exclusive or (one",
        ),
        ("x^2 + y^2 < 1", "a power is written x**2"),
        ("a -> x > y^2", "a power is written y**2"),
        ("abs(x)^y < 1", "a power is written abs(x)**y"),
        ("2 * (x + 1)^y < 1", "a power is written (x + 1)**y"),
        ("x > 0 ^ b", "a power is written 0**b"),
        ("x^y < 1", "a power is written x**y"),
        ("(x^y) < 1", "not the formula '(x^y)'; a power is written x**2"),
        ("x**y**z > 1", "a chain of '**' is ambiguous: write x ** (y ** z) or (x ** y) ** z"),
        ("a & 3", "a formula is needed here, not the number 3"),
        ("", "a formula is needed; got an empty text"),
        ("a b", "but found 'b'"),
        ("alwys x < 1", "but found 'x'; did you mean 'always' instead of 'alwys'?"),
        ("evntually[0,2] x < 1", "; did you mean 'eventually' instead of 'evntually'?"),
        ("x > 1 untl y > 1", "but found 'untl'"),
        ("abs > 1", "abs is a function: write abs(x), or quote it if it is a signal"),
        ("p[1.5] > 2", "a component is a signal and a whole number, as in p[0]"),
        ("(x + y)[0] > 2", "a component is a signal and a whole number"),
    ],
)
def test_a_text_that_is_not_a_formula_is_refused(text, message):
    with pytest.raises(FormulaSyntaxError) as caught:
        parse(text)
    assert message in str(caught.value).split("\n")[0]


def test_the_caret_stands_under_the_place():
    with pytest.raises(FormulaSyntaxError) as caught:
        parse("x > 1 &\n  y >= >= 2")
    assert str(caught.value).split("\n")[1:] == ["    y >= >= 2", "         ^^"]
    assert caught.value.position == 15
    with pytest.raises(FormulaSyntaxError) as caught:
        parse("always (x^2 < 0.5)")
    assert str(caught.value).split("\n")[1:] == ["  always (x^2 < 0.5)", "           ^"]


def test_constants_and_definitions():
    formula = parse(
        "G[0,T] (safe -> x < vmax)",
        constants={"T": 3, "vmax": 2.5, "margin": 0.1},
        definitions={"far": Y > 1, "safe": "far & x > margin"},
    )
    assert formula == always(((Y > 1) & (X > 0.1)) >> (X < 2.5), 0, 3)
    with pytest.raises(ValueError, match="'T' is both a constant and a definition"):
        parse("T", constants={"T": 3}, definitions={"T": "x > 0"})
    with (
        unchecked(),
        pytest.raises(ValueError, match="a definition's name must be an identifier; got 'a b'"),
    ):
        parse("x > 0", definitions={"a b": "x > 0"})
    with pytest.raises(FormulaSyntaxError):
        parse("safe", definitions={"safe": "x >"})
    with unchecked(), pytest.raises(TypeError, match="a formula's text is a str; got int"):
        parse(3)


def test_python_refuses_what_makes_no_sense():
    with pytest.raises(ValueError, match=r"ends no earlier than it starts; got \[3,1\]"):
        always(X > 0, 3, 1)
    with pytest.raises(ValueError, match=r"starts at a finite time, at least 0; got \[-1,1\]"):
        always(X > 0, -1, 1)
    with (
        unchecked(),
        pytest.raises(TypeError, match="a number or a signal is needed here; got 'three'"),
    ):
        X > "three"  # noqa: B015
    with unchecked(), pytest.raises(TypeError, match="a formula is needed here; got 3"):
        always(3)
    with (
        unchecked(),
        pytest.raises(ValueError, match="a number in a formula must be finite; got nan"),
    ):
        float("nan") < X  # noqa: B015
    with unchecked(), pytest.raises(TypeError, match=r"between formulas; a power is x\*\*2"):
        X ^ 2
    with unchecked(), pytest.raises(TypeError, match=r"between formulas; a power is 2\*\*x"):
        2 ^ X
    with pytest.raises(ValueError, match="a formula is needed here, not the number 3"):
        always(expression(3))
    with pytest.raises(ValueError, match="only a signal has components"):
        (X + 1)[0]
    with pytest.raises(ValueError, match="without quotes or line breaks"):
        signal('a"b')


def test_a_formula_knows_its_signals_and_its_horizon():
    formula = parse("G[0,2] (x > 0 -> F[0.5,1] (y > 0 U[0,3] z)) & O[0,9] w & x < 1")
    assert formula.signals() == ("x", "y", "z", "w")
    assert formula.horizon() == 6.0
    assert parse("G[0,2] X X a").horizon(0.1) == pytest.approx(2.2)
    assert parse("F G[0,1] a").horizon() == float("inf")
    assert parse("H a").horizon() == 0
    assert nnf(parse("!(G[0,1] (x > 0 & !a))")) == parse("F[0,1] (x <= 0 | a)")
    assert nnf(parse("!(X (x == 1))")) == parse("X (x != 1)")
    assert simplify(parse("G G[0.1,0.2] !!a & TRUE")) == parse("G[0.1,inf] a")
    assert simplify(parse("G[0.1,0.2] G[0.2,0.4] a")) == parse("G[0.3,0.6] a")
    assert simplify(parse("(a & a) | FALSE")) == parse("a")
    assert simplify(parse("TRUE U[1,2] a")) == parse("F[1,2] a")
    assert simplify(parse("a & FALSE")) == FALSE


def test_a_formula_is_written_in_latex():
    assert latex(parse("-(x / 2)**2 > y**-1")) == (
        r"-\left(\frac{\mathit{x}}{2}\right)^{2} > \mathit{y}^{-1}"
    )
    text = latex(parse("G[0,4] (abs(x_1) <= 2 -> F (norm(p) / 2 > y & !a))"))
    assert text == (
        r"\Box_{[0, 4]} \left(\left|\mathit{x\_1}\right| \leq 2 \rightarrow "
        r"\left(\Diamond \left(\frac{\left\lVert\mathit{p}\right\rVert}{2} > \mathit{y} \land "
        r"\left(\lnot \left(\mathit{a}\right)\right)\right)\right)\right)"
    )


DEEP = {
    "parentheses": "(" * 100 + "x > 0" + ")" * 100,
    "always": "G " * 40 + "x > 0",
    "not": "!" * 100 + "(x > 0)",
    "and": "(x > 0 & " * 100 + "x > 1" + ")" * 100,
    "implies": "(x > 0 -> " * 50 + "x > 1" + ")" * 50,
    "iff": "(x > 0 <-> " * 30 + "x > 1" + ")" * 30,
    "abs": "abs(" * 100 + "x" + ")" * 100 + " > 0",
    "sum": " + ".join(["x"] * 600) + " > 0",
}


@pytest.mark.parametrize("name", DEEP)
def test_deep_texts_are_formulas_like_any_other(name):
    # Notebooks and frameworks call from deep in Python's stack, which has room for 1000.
    called_from(300, lambda: like_any_other(DEEP[name]))


def called_from(depth, function):
    return called_from(depth - 1, function) if depth else function()


def like_any_other(text):
    f = parse(text)
    again = parse(str(f))
    assert again == f
    assert hash(again) == hash(f)
    assert f.signals() == ("x",)
    assert f.horizon() in (0, math.inf)
    assert repr(f)
    assert latex(f)
    assert nnf(simplify(f)).signals() == ("x",)


def test_a_formula_travels_to_other_processes():
    f = parse("(x > 0 <-> y) -> F[0,1] x + 2 > y")
    hash(f)
    copy = pickle.loads(pickle.dumps(f))
    assert copy == f
    assert "_hash" not in pickle.loads(pickle.dumps(f)).__dict__


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["not", "and", "iff", "sum"])
def test_deep_texts_have_a_robustness(name):
    trace = Trace({"x": np.array([2.0, 1.5])}, dt=0.1)
    assert np.isfinite(robustness(DEEP[name], trace))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("(" * 101 + "x > 0" + ")" * 101, "parentheses stand at most 100 deep"),
        ("(" * 100_000, "parentheses stand at most 100 deep"),
        ("!" * 101 + "(x > 0)", "operators stand at most 100 deep"),
        ("G " * 41 + "x > 0", "temporal operators stand at most 40 deep"),
        ("F[0,1] G " * 30 + "x > 0", "temporal operators stand at most 40 deep"),
        ("x > 0 & " * 3000 + "x > 1", "at most 10000 words and symbols"),
        ("-" * 5000 + "x > 0", "at most 100 minus signs"),
        ("F[0,1e9999999] x > 0", "a time must be a finite number of seconds"),
        ("F[0,1e99999999999999999999] x > 0", "a time must be a finite number of seconds"),
        ("F[0," + "1" * 100_000 + "] x > 0", "a time must be a finite number of seconds"),
        ("x > 1e999", "a number in a formula must be finite"),
        (" + ".join(["1"] * 3000) + " > 0", "compares numbers but no signal"),
        ("x / 0 > 1", "a division by zero: x / 0"),
        ("1 / 0 > x", "a division by zero: 1 / 0"),
        ("x / (1 - 1) > 1", "a division by zero: x / (1 - 1)"),
        ("x / sin(min(0, 3)) > 1", "a division by zero: x / sin(min(0, 3))"),
        ("x > 1e300 * 1e300", "a number in a formula must be finite; 1e+300 * 1e+300 is not"),
        ("x > sqrt(1 - 2)", "a number in a formula must be finite; sqrt(1 - 2) is not"),
        ("x > (0 - 8)**0.5", "a number in a formula must be finite; (0 - 8)**0.5 is not"),
        ("F[0, nan] x > 0", "F"),
    ],
)
def test_a_text_beyond_the_limits_is_refused_at_once(text, said):
    constants = {"nan": math.nan}
    with pytest.raises(FormulaSyntaxError) as refused:
        parse(text, constants)
    message = str(refused.value)
    assert said in message
    assert "^" in message.splitlines()[-1]
    assert len(message) < 2000


@pytest.mark.parametrize(
    ("text", "offers"),
    [
        (
            "always[0,2](x)>0 and y>0",
            ["always[0,2] ((x)>0 and y>0)", "(always[0,2](x)>0) and y>0"],
        ),
        (
            "always x > 0 and always y > 0 and z > 0",
            [
                "always (x > 0 and always (y > 0 and z > 0))",
                "(always x > 0) and (always y > 0) and z > 0",
            ],
        ),
        (
            "always eventually x > 0\n  -> y > 0",
            ["always eventually (x > 0 -> y > 0)", "(always eventually x > 0) -> y > 0"],
        ),
        ("!once x|y", ["!once (x|y)", "(!once x)|y"]),
        ("a U[0,1] b U c U d", ["a U[0,1] (b U (c U d))", "((a U[0,1] b) U c) U d"]),
        ("0 < x < y < 1", ["(0 < x) & (x < y) & (y < 1)"]),
        ("0 < 1 < x", []),
        ("G[5,-1] x", []),
        ("always " + "a" * 400 + " & b", []),
    ],
)
def test_what_an_error_offers_can_be_read(text, offers):
    with pytest.raises(FormulaSyntaxError) as caught:
        parse(text)
    said = str(caught.value).split("\n")[0]
    assert said.endswith(f"write {' or '.join(offers)}") if offers else "write" not in said
    for offer in offers:
        parse(offer)


def test_units_of_time():
    assert parse("G[0, 2 h] x") == parse("G[0, 120 min] x")
    assert parse("F[1d, 2 d] x") == parse("F[86400, 172800] x")
    assert parse("G[0,2] d > h") == parse("G[0,2] (d > h)")  # Signals may still be called so.


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.25, "0.25 s"),
        (599.5, "599.5 s"),
        (600, "10 min"),
        (5400.0, "1 h 30 min"),
        (39780.5, "11 h 3 min 0.5 s"),
        (86399.9999999, "1 d"),
        (-7200, "-2 h"),
        (np.float64(7200.0), "2 h"),
        (1700000003.5, "1700000003.5 s"),
        (float("inf"), "inf s"),
    ],
)
def test_times_are_written_in_the_units_of_a_person(seconds, text):
    assert format_seconds(seconds) == text


def test_a_power_is_offered_with_its_parentheses():
    with pytest.raises(TypeError, match=r"a power is \(x \+ 1\)\*\*2$"):
        (X + 1) ^ 2

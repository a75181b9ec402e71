"""sejax.registry: dataclasses as plain values and back; what does not fit is one message."""

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sejax.options import ConfigError
from sejax.registry import flatten, from_plain, to_plain


@dataclass(frozen=True)
class Inner:
    size: int = 3
    names: tuple[str, ...] = ("a",)


@dataclass(frozen=True)
class Outer:
    """A field of each kind."""

    number: float = 0.5
    count: int = 2
    flag: bool = False
    word: str = "w"
    limit: int | None = None
    either: int | str = 1
    mode: Literal["fast", "exact"] = "fast"
    sizes: tuple[int, ...] = (1, 2)
    steps: list[float] = dataclasses.field(default_factory=list)
    anything: Any = None
    inner: Inner = Inner()
    maybe: Inner | None = None


def read(**values):
    return from_plain(Outer, values, "here")


def refused(**values):
    with pytest.raises(ConfigError) as error:
        read(**values)
    return str(error.value)


# --- as plain values -----------------------------------------------------------------------------


def test_plain_values_are_numbers_words_lists_and_dictionaries():
    assert to_plain(Outer(anything={1: (Inner(), None)}, maybe=Inner(size=4, names=()))) == {
        "number": 0.5, "count": 2, "flag": False, "word": "w", "limit": None, "either": 1,
        "mode": "fast", "sizes": [1, 2], "steps": [],
        "anything": {"1": [{"size": 3, "names": ["a"]}, None]},
        "inner": {"size": 3, "names": ["a"]}, "maybe": {"size": 4, "names": []},
    }  # fmt: skip


def test_settings_are_flattened_by_their_names():
    assert flatten({"a": 1, "b": {"c": {"d": 2}, "e": None}, "f": {}}) == {
        "a": 1, "b.c.d": 2, "b.e": None,
    }  # fmt: skip


words = st.text(max_size=5)
counts = st.integers(-(2**40), 2**40)
inners = st.builds(Inner, size=counts, names=st.lists(words, max_size=3).map(tuple))
outers = st.builds(
    Outer,
    number=st.floats(allow_nan=False), count=counts, flag=st.booleans(), word=words,
    limit=st.none() | counts, either=counts | words, mode=st.sampled_from(["fast", "exact"]),
    sizes=st.lists(counts, max_size=3).map(tuple),
    steps=st.lists(st.floats(allow_nan=False), max_size=3),
    anything=st.none() | counts | st.lists(words, max_size=2) | st.dictionaries(words, counts),
    inner=inners, maybe=st.none() | inners,
)  # fmt: skip


@given(outers)
def test_what_is_written_as_json_reads_back_the_same(config):
    assert from_plain(Outer, json.loads(json.dumps(to_plain(config))), "") == config


@given(
    st.dictionaries(words, st.none() | counts | words | st.lists(counts, max_size=2), max_size=3)
)
def test_values_of_any_kind_are_read_or_refused_with_one_message(values):
    try:
        config = from_plain(Outer, values, "")
    except ConfigError as error:
        assert " must be " in str(error) or " must have " in str(error)
    else:
        assert values.keys() <= {field.name for field in dataclasses.fields(config)}


# --- values as they are meant --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "given", "got"),
    [
        ("number", 3, 3.0), ("number", 2**70, 2.0**70), ("count", 3.0, 3), ("count", 1e3, 1000),
        ("word", 3, "3"), ("word", 0.5, "0.5"), ("limit", 3.0, 3), ("limit", None, None),
        ("either", "x", "x"), ("either", 3, 3), ("either", 3.0, 3), ("sizes", [1.0, 2], (1, 2)),
        ("sizes", (), ()), ("steps", (1, 2), [1.0, 2.0]), ("inner", {}, Inner()),
        ("inner", {"size": 1.0}, Inner(size=1)), ("inner", Inner(size=9), Inner(size=9)),
        ("maybe", {"names": ["x"]}, Inner(names=("x",))), ("anything", {"a": [1]}, {"a": [1]}),
        ("mode", "exact", "exact"),
    ],
)  # fmt: skip
def test_a_value_is_taken_as_it_is_meant(name, given, got):
    value = getattr(read(**{name: given}), name)
    assert value == got and type(value) is type(got)


def test_a_number_may_be_none_where_floats_are():
    assert math.isnan(read(number=math.nan).number) and read(number=math.inf).number == math.inf


def test_nothing_in_a_value_is_resolved():
    for text in ("${oc.env:HOME}", "???", "!!python/name:os.system", "null"):
        assert read(word=text).word == text


def test_fields_that_are_left_out_have_their_defaults():
    assert read() == Outer()
    assert read().steps is not read().steps


# --- messages ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"count": "3"}, "here.count must be a whole number, because that is its type; got '3'. "
         "Set here.count=2."),
        ({"count": 1.5}, "here.count must be a whole number, because that is its type; got 1.5. "
         "Set here.count=2."),
        ({"count": True}, "here.count must be a whole number, because that is its type; got True. "
         "Set here.count=2."),
        ({"count": None}, "here.count must be a whole number, because that is its type; got None. "
         "Set here.count=2."),
        ({"number": "much"}, "here.number must be a number, because that is its type; got 'much'. "
         "Set here.number=0.5."),
        ({"number": False}, "here.number must be a number, because that is its type; got False. "
         "Set here.number=0.5."),
        ({"flag": 1}, "here.flag must be true or false, because that is its type; got 1. "
         "Set here.flag=false."),
        ({"flag": "true"}, "here.flag must be true or false, because that is its type; got 'true'. "
         "Set here.flag=false."),
        ({"word": ["x"]}, "here.word must be a word, because that is its type; got ['x']. "
         "Set here.word=w."),
        ({"limit": "x"}, "here.limit must be a whole number, because that is its type; got 'x'. "
         "Set here.limit=null."),
        ({"either": [1]}, "here.either must be a word, because that is its type; got [1]. "
         "Set here.either=1."),
        ({"mode": "slow"}, "here.mode must be one of fast, exact, because nothing else is known; "
         "got slow. Set here.mode=fast."),
        ({"sizes": 3}, "here.sizes must be a list, because it holds several values; got 3. "
         "Set here.sizes=[...]."),
        ({"sizes": "12"}, "here.sizes must be a list, because it holds several values; got '12'. "
         "Set here.sizes=[...]."),
        ({"sizes": [1, "x"]}, "here.sizes must be a whole number, because that is its type; got "
         "'x'. Set here.sizes=(1, 2)."),
        ({"inner": 3}, "here.inner must have the fields size, names, because it is more than one "
         "value; got 3. Set here.inner.size=VALUE."),
        ({"inner": {"size": "x"}}, "here.inner.size must be a whole number, because that is its "
         "type; got 'x'. Set here.inner.size=3."),
        ({"inner": {"siz": 1}}, "here.inner.siz must be a field of Inner, because nothing else is "
         "read; got 1. Fields there: size, names."),
        ({"wrd": 1}, "here.wrd must be a field of Outer, because nothing else is read; got 1. "
         "Fields there: word, "),
    ],
)  # fmt: skip
def test_a_value_that_does_not_fit_is_refused_with_the_whole_message(values, said):
    assert refused(**values).startswith(said)


def test_numbers_too_large_for_their_type_are_refused_as_such():
    assert "number must be a number" in refused(number=10**400)
    assert "count must be a whole number" in refused(count=1e300)


def test_a_field_without_a_default_must_be_given():
    needy = dataclasses.make_dataclass("Needy", [("size", int)])
    with pytest.raises(ConfigError, match=r"^agent\.size must be given, because it has no default; "
                                          r"got none\. Set agent\.size=VALUE\.$"):  # fmt: skip
        from_plain(needy, {}, "agent")
    assert from_plain(needy, {"size": 2.0}, "agent").size == 2
    nothing = dataclasses.make_dataclass("Nothing", [])
    with pytest.raises(
        ConfigError, match=r"^x must be a field of Nothing, .* Fields there: none\."
    ):
        from_plain(nothing, {"x": 1}, "")


def test_messages_are_short_and_without_a_prefix_where_there_is_none():
    with pytest.raises(ConfigError) as error:
        from_plain(Outer, {"n" * 10_000: "v" * 10_000}, "")
    said = str(error.value)
    assert said.startswith("nnn") and "(10000 characters)" in said and len(said) < 1000
    assert len(refused(count="v" * 10_000)) < 1000


def test_fields_that_are_not_set_at_the_start_are_no_settings():
    @dataclass
    class Derived:
        size: int = 2
        square: int = dataclasses.field(init=False, default=4)

    assert from_plain(Derived, {"size": 3}, "").size == 3
    with pytest.raises(ConfigError, match=r"^square must be a field of Derived"):
        from_plain(Derived, {"square": 9}, "")
    assert to_plain(Derived()) == {"size": 2}

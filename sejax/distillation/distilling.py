"""What `python -m sejax.distill` does: find policies, teach them, and write the best SE."""

import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
import yaml
from jaxtyping import Array

from sejax.agents import make_agent
from sejax.distillation import policies, teaching
from sejax.distillation.config import DistillConfig
from sejax.distillation.policy_copy import copy_policy, visit
from sejax.distillation.policy_search import Policy, SearchConfig, make_search
from sejax.distillation.teaching import Lesson
from sejax.ops import checksummed
from sejax.ops.files import write_bytes, write_text
from sejax.options import ConfigError, require
from sejax.options.plain import differences, to_plain
from sejax.proxies import header, zoo
from sejax.proxies.io import fingerprint, save
from sejax.runs import config as configuration
from sejax.runs.config import LearnConfig

ASKED = "distill.yaml"
CHECKPOINT, KIND = "search.safetensors", "sejax_search"
CHOOSE, TEST = "choose", "test"  # what students are for
Costs = dict[str, Any]  # real_steps and cpu_s


def distill(own: DistillConfig, config: LearnConfig, folder: Path, words: str = "") -> Path:
    """Finds policies, teaches them, and writes the SE that teaches best.

    Args:
      own: how policies are found, and how many students there are.
      config: task, students and their trainings, and seed.
      folder: where files are written, and the search goes on.
      words: the command's overrides, for the card.

    Returns:
      The SE's file.

    Raises:
      ConfigError: for a folder of another search, or a policy that cannot be.
      OSError: if a file cannot be written.
    """
    _require_same(own, config, folder)
    find = search if own.policy is None else copied
    lessons, costs = find(own, config, folder)
    env, weights = teaching.make_ses(config.task(), lessons, **own.of_ses)
    best, chosen_by = 0, pd.DataFrame()
    if len(lessons) > 1:
        chosen_by = students(own, config, lessons, CHOOSE, folder)
        grades = teaching.grades(chosen_by)
        _print_grades(chosen_by, grades)
        best = [each.generation for each in lessons].index(int(grades.idxmax()))
    rows = pd.concat([chosen_by, students(own, config, [lessons[best]], TEST, folder)])
    write_text(folder / "students.csv", rows.to_csv(index=False))
    costs["cpu_s"] += rows["cpu_s"].sum()
    costs["real_steps"] += int(rows["real_steps"].sum())
    path = folder / "proxy.safetensors"
    _save(path, env, weights[best], own, config, lessons[best], rows, costs, words)
    return path


def keys_of(config: LearnConfig) -> dict[str, Array]:
    """A key for each use of random numbers."""
    uses = ("search", "test", "record", CHOOSE, TEST)
    return dict(zip(uses, jax.random.split(jax.random.key(config.seed), len(uses)), strict=True))


# --- the search -----------------------------------------------------------------------------------


def search(own: DistillConfig, config: LearnConfig, folder: Path) -> tuple[list[Lesson], Costs]:
    """The policies that are to be taught, and what finding them cost.

    Each block of generations up to a test is kept before the next begins.
    """
    task, options = config.task(), own.search
    made = make_search(options, task, config.devices)
    tested, rows = _restored(folder, made.init())
    _remember(own, config, folder)
    keys = keys_of(config)
    print("searching a policy ...", flush=True)
    run = jax.jit(made.generation)
    test, record = jax.jit(made.test), jax.jit(made.record)
    while (block := _next_block(options, rows)) is not None:
        started, num_steps, returns = time.process_time(), 0, []
        last = min(block.first + options.test_every, options.generations)
        policy = made.init() if block.goes_on_from is None else tested[block.goes_on_from]
        key_search, key_test = (
            jax.random.fold_in(keys[use], block.start) for use in ("search", "test")
        )
        for number in range(block.first, last):
            policy, tried = run(jax.random.fold_in(key_search, number), policy, number)
            num_steps += int(tried.num_steps)
            returns.append(float(tried.returns.mean()))
        tests = test(jax.random.fold_in(key_test, last), policy)
        row = {
            "start": block.start,
            "generation": last,
            "population_mean": float(np.mean(returns)),
            "test_mean": float(tests.returns.mean()),
            "test_std": float(tests.returns.std()),
            "real_steps": num_steps + int(tests.num_steps.sum()),
            "cpu_s": time.process_time() - started,
        }
        tested, rows = [*tested, policy], [*rows, row]
        _keep(folder, tested, rows)
        steps = sum(each["real_steps"] for each in rows)
        print(
            f"start {block.start}/{options.num_starts - 1}, generation "
            f"{last}/{options.generations}: policy {row['test_mean']:.1f} ± "
            f"{row['test_std']:.1f}, {steps:,} real steps",
            flush=True,
        )
    curve, lessons = pd.DataFrame(rows), []
    went_on = curve[curve["start"] == _best_start(rows)]
    for part in np.array_split(np.arange(len(went_on)), own.num_snapshots):
        started = time.process_time()
        number = int(went_on.iloc[part]["test_mean"].fillna(-np.inf).idxmax())
        policy, generation = tested[number], int(curve["generation"][number])
        # Episodes of their own: the tests had a part in choosing.
        seen = record(jax.random.fold_in(keys["record"], generation), policy)
        valid = np.asarray(seen.valid)
        states, total = np.asarray(seen.obs)[valid], float(np.asarray(seen.reward)[valid].sum())
        layers = policy.layers(task.max_action)
        curve.loc[number, "real_steps"] += len(states)
        curve.loc[number, "cpu_s"] += time.process_time() - started
        lessons.append(Lesson(generation, layers, states, total / options.num_tests))
    write_text(folder / "search.csv", curve.to_csv(index=False))
    costs = {"cpu_s": float(curve["cpu_s"].sum()), "real_steps": int(curve["real_steps"].sum())}
    return lessons, costs


class Block(NamedTuple):
    """Generations up to a test.

    Attributes:
      start: the search that they are of.
      first: its first generation.
      goes_on_from: the number of the tested policy that it goes on from; None for a new one.
    """

    start: int
    first: int
    goes_on_from: int | None


def _next_block(options: SearchConfig, rows: list[dict[str, Any]]) -> Block | None:
    """What follows the blocks of `rows`: all starts one after another, then the best of them."""
    tried = min(options.start_generations, options.generations)
    num_blocks = -(-tried // options.test_every)
    if len(rows) < options.num_starts * num_blocks:
        start, number = divmod(len(rows), num_blocks)
    else:
        start = _best_start(rows)
        number = len(rows) - (options.num_starts - 1) * num_blocks
    first = number * options.test_every
    if first >= options.generations:
        return None
    own = [i for i, row in enumerate(rows) if row["start"] == start]
    return Block(start, first, own[-1] if own else None)


def _best_start(rows: list[dict[str, Any]]) -> int:
    """The start with the policy that was tested best."""
    best = max(rows, key=lambda row: np.nan_to_num(row["test_mean"], nan=-np.inf))
    return int(best["start"])


def copied(own: DistillConfig, config: LearnConfig, folder: Path) -> tuple[list[Lesson], Costs]:
    """The given policy, or its copy, as the only one that is taught; see `search`."""
    task = config.task()
    assert own.policy is not None
    given = policies.policy_of(own.policy, task)
    started, key = time.process_time(), keys_of(config)["record"]
    if given.layers is None:
        print("copying the policy ...", flush=True)
        made = copy_policy(own.copy, task, given.act, key)
        lesson = Lesson(0, made.layers, made.states, made.policy_return)
        real_steps = made.real_steps
        print(f"policy {made.policy_return:.1f}, its copy {made.copy_return:.1f}", flush=True)
    else:
        seen = visit(task, given.act, key, own.copy.episodes)
        lesson = Lesson(0, given.layers, seen.states, float(seen.returns.mean()))
        real_steps = len(seen.states)
        print(f"policy {lesson.policy_return:.1f}", flush=True)
    _remember(own, config, folder)
    return [lesson], {"cpu_s": time.process_time() - started, "real_steps": real_steps}


def asked(own: DistillConfig, config: LearnConfig) -> dict[str, Any]:
    """What the numbers depend on, as plain values."""
    others = {"run_dir", "devices"}
    plain = configuration.plain(config)
    return to_plain(own) | {name: plain[name] for name in plain if name not in others}


def _require_same(own: DistillConfig, config: LearnConfig, folder: Path) -> None:
    """Checks that what is asked for is what the folder was made with, if it is not new."""
    path, wanted = folder / ASKED, asked(own, config)
    if not path.exists():
        return
    try:
        stored = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        stored = None
    require(
        isinstance(stored, dict),
        "run_dir",
        f"must hold {ASKED} as it was written; got {folder}, where it is damaged. Set "
        "run_dir=FOLDER, another one.",
    )
    differing = differences(stored, json.loads(json.dumps(wanted)))
    require(
        not differing,
        "run_dir",
        f"must hold what the same command made; got {folder}, with {differing}. Set "
        "run_dir=FOLDER, another one.",
    )


def _remember(own: DistillConfig, config: LearnConfig, folder: Path) -> None:
    """Writes what was asked for, when there is something to keep."""
    write_text(folder / ASKED, yaml.safe_dump(asked(own, config), sort_keys=False))


def _keep(folder: Path, tested: list[Policy], rows: list[dict[str, Any]]) -> None:
    tensors = {
        name: np.stack([np.asarray(getattr(policy, name)) for policy in tested])
        for name in tested[0]._fields
    }
    write_bytes(folder / CHECKPOINT, checksummed.pack(tensors, KIND, {"rows": rows}))


def _restored(folder: Path, policy: Policy) -> tuple[list[Policy], list[dict[str, Any]]]:
    """The policies that were tested, and the rows of `search.csv`; none in a new folder.

    Raises:
      ConfigError: for a damaged file.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        return [], []
    try:
        tensors, manifest = checksummed.read(path, KIND)
    except checksummed.DamagedError as error:
        raise ConfigError(
            f"run_dir must hold a search as it was written; got {path}, which is damaged "
            f"({error}). Set run_dir=FOLDER, another one.",
            "run_dir",
        ) from error
    rows = manifest["rows"]
    require(
        all("start" in row for row in rows),
        "run_dir",
        f"must hold a search of this version; got {folder}. Set run_dir=FOLDER, another one.",
    )
    tested = [type(policy)(**{name: x[i] for name, x in tensors.items()}) for i in range(len(rows))]
    return tested, rows


# --- students -------------------------------------------------------------------------------------


def students(
    own: DistillConfig,
    config: LearnConfig,
    lessons: Sequence[Lesson],
    use: str,
    folder: Path,
) -> pd.DataFrame:
    """A row for each student on the SE of each lesson; see `sejax.distillation.teaching`.

    Those that choose an SE (`CHOOSE`) are others than those that test it (`TEST`). The rows of each
    kind, on SEs of these weights, are kept in the folder before the next kind trains.
    """
    task, found = config.task(), []
    env, weights = teaching.make_ses(task, lessons, **own.of_ses)
    keys = jax.random.split(
        keys_of(config)[use], own.num_students if use == CHOOSE else own.num_tested
    )
    # The file that `policy` names may have changed.
    taught_by = fingerprint({str(i): each for i, each in enumerate(weights)})
    for key, agent_config in config.agents.items():
        path = folder / "students" / f"{use}-{key}-{taught_by}.csv"
        if not path.exists():
            agent = make_agent(agent_config, task, config.exploration)
            print(f"training {len(keys) * len(lessons)} {key} students ...", flush=True)
            started = time.process_time()
            taught = teaching.teach(env, weights, agent, config.training, keys, config.devices)
            new = teaching.as_rows(taught, lessons, key, use)
            new = new.assign(cpu_s=(time.process_time() - started) / len(new))
            write_text(path, new.to_csv(index=False))
        rows = pd.read_csv(path)  # also new ones, so that both are the same
        found.append(rows)
        returns = teaching.counted(rows["test_return"])
        print(
            f"{len(rows)} {key} students reach {returns.mean():.1f}, the worst {returns.min():.1f}",
            flush=True,
        )
    return pd.concat(found, ignore_index=True)


def _print_grades(rows: pd.DataFrame, grades: pd.Series) -> None:
    from rich.console import Console
    from rich.table import Table

    kinds = list(dict.fromkeys(rows["agent"]))
    table = Table(title="What the SE of each policy teaches: mean and worst student")
    for column in ("generation", "policy", *kinds, "grade"):
        table.add_column(column, justify="right")
    for generation, mine in rows.groupby("generation"):
        cells = [f"{generation}", f"{mine['policy_return'].iloc[0]:.1f}"]
        for kind in kinds:
            returns = mine[mine["agent"] == kind]["test_return"]
            cells.append(f"{returns.mean():.1f}, {returns.min():.1f}")
        table.add_row(*cells, f"{grades[generation]:.1f}")
    Console(highlight=False).print(table)


# --- the file -------------------------------------------------------------------------------------


def _save(
    path: Path,
    env: Any,
    weights: Any,
    own: DistillConfig,
    config: LearnConfig,
    lesson: Lesson,
    rows: pd.DataFrame,
    costs: dict[str, Any],
    words: str,
) -> None:
    """Writes the SE with its record, and its card."""
    tested = rows[rows["use"] == TEST]
    evaluations = [
        zoo.Evaluation(
            agent=kind,
            hparams="as_learned",
            world="proxy",
            num_agents=len(mine),
            return_mean=float(teaching.counted(mine["test_return"]).mean()),
            return_std=float(teaching.counted(mine["test_return"]).std(ddof=0)),
            train_steps=float(mine["train_steps"].mean()),
        )
        for kind, mine in tested.groupby("agent", sort=False)
    ]
    learning = zoo.Learning(
        command=f"python -m sejax.distill {words}".rstrip(),
        generations=own.search.generations if own.policy is None else 0,
        real_steps=costs["real_steps"],
        agents=len(rows),
        train_steps=int(rows["train_steps"].sum()),
        cpu_s=round(float(costs["cpu_s"]), 1),
    )
    plain = configuration.plain(config)
    others = {name: plain[name] for name in plain if name not in ("env", "proxy")}
    save(
        path,
        env,
        weights,
        others,
        generation=lesson.generation,
        seed=config.seed,
        policy_return=lesson.policy_return,
        evaluations=[dataclasses.asdict(each) for each in evaluations],
        learning=dataclasses.asdict(learning),
    )
    card = zoo.describe(header.read(path, single=True)).card
    write_text(path.with_name("card.md"), f"{card}\n")
    for each in evaluations:
        print(f"{each.agent}: {each.return_mean:.1f} ± {each.return_std:.1f}, fresh students")
    print(
        f"{path} holds the SE of generation {lesson.generation}: {learning.real_steps:,} real "
        f"steps, {learning.cpu_s:,.0f} CPU s."
    )

"""The study of a search: its database, the loop in which a worker takes trials, and the results.

Workers of a study share its folder. A worker locks its trial; the lock ends with the worker's
process, even if that is killed. The next worker goes on with a running trial whose lock is free.
"""

import contextlib
import dataclasses
import functools
import shlex
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import filelock
import numpy as np
import optuna
import pandas as pd
import yaml
from optuna.trial import Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from sejax.ops.files import require_writable, write_text
from sejax.options import ConfigError, FailedError, place_of, told
from sejax.options.plain import parsed
from sejax.runs import session
from sejax.runs.chunks import Chunks
from sejax.runs.config import LearnConfig
from sejax.runs.run_directory import RunDirectory
from sejax.runs.runtime import platform_error
from sejax.runs.store import Store
from sejax.search.config import REDUCTION_FACTOR, StudyPlan

WAIT = 3600  # s, for another worker's write to the database
UNUSABLE = (optuna.exceptions.OptunaError, SQLAlchemyError)  # errors of a database
SHOWN = ["number", "value", "generations", "train_steps", "settings"]  # columns of a trial


def open_study(plan: StudyPlan) -> optuna.Study:
    """Opens the study, or makes it; a new one first tries the current settings, if in range.

    Raises:
      ConfigError: if the folder cannot be used, or holds the study of another search.
      OptunaError, SQLAlchemyError: if the database cannot be used.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    folder = plan.folder
    with contextlib.suppress(OSError, ValueError):  # what the next line raises
        (folder / "trials").mkdir(parents=True, exist_ok=True)
    require_writable("search_dir", folder / "trials")
    store = Store(folder, plan.settings(), field="search_dir", free=plan.free)
    budgets = plan.config.min_generations, plan.config.max_generations
    # An address would end at a question mark in the folder's name.
    connect = functools.partial(sqlite3.connect, folder / "study.db", WAIT, check_same_thread=False)
    with _lock(plan, "study"):
        is_new = store.get("search") is None
        study = optuna.create_study(
            study_name=plan.study_name,
            storage=optuna.storages.RDBStorage("sqlite:///study.db", {"creator": connect}),
            pruner=optuna.pruners.HyperbandPruner(*budgets, REDUCTION_FACTOR),
            direction="maximize",
            load_if_exists=True,
        )
        try:
            for trial in study.get_trials(deepcopy=False):  # reads all of it
                # A trial that was told by hand may have no scores of generations.
                score = trial.intermediate_values.get(budgets[1], trial.value)
                if trial.state == TrialState.COMPLETE and trial.value != score:
                    raise ValueError(f"trial {trial.number} has two scores")
                settings = trial.user_attrs.get("settings")
                if settings and settings != shlex.join(plan.overrides(trial.params)):
                    raise ValueError(f"trial {trial.number} has two settings")
        except (KeyError, TypeError, ValueError) as error:  # somebody else has written there
            raise optuna.exceptions.StorageInternalError(told(error)) from error
        if is_new:
            fields = plan.default.in_words(plan.default.plain())
            first = {x.parameter: x.parameter_of(fields[name]) for name, x in plan.space.items()}
            if None not in first.values():
                study.enqueue_trial(first, skip_if_exists=True)
            store.put("search")
    return study


# --- trials ---------------------------------------------------------------------------------------


class Progress(NamedTuple):
    """How a trial has gone so far.

    Attributes:
      scores: `[generation]`, the trial's score after each generation; nan if it is not finite.
      train_steps: training steps of all agents.
      generations: computed generations, the mean over seeds; fewer than scores if runs have solved
        their task.
      is_over: whether all runs have solved their task.
    """

    scores: np.ndarray
    train_steps: int
    generations: float
    is_over: bool


def make_run(config: LearnConfig, folder: Path, seeds: Sequence[int]) -> Callable[[int], Progress]:
    """Runs that learn proxies, a run directory each, by one executable.

    A score is the search mean's score, averaged over seeds. A run that has solved its task keeps
    its last score.

    Args:
      config: the runs' configuration.
      folder: the run directory; for several runs, with a folder for each seed.
      seeds: counted from the configuration's own.

    Returns:
      A function that continues the runs up to a number of generations.
    """
    chunks = Chunks(config)

    def run(generations: int) -> Progress:
        means, summaries = [], []
        for seed in (config.seed + offset for offset in seeds):
            run_dir = str(folder if len(seeds) == 1 else folder / f"seed{seed}")
            one = dataclasses.replace(config, seed=seed, generations=generations, run_dir=run_dir)
            with RunDirectory(one, "search_dir") as directory:
                summaries.append(session.run(one, directory, chunks))
            of_run = [float(row["incumbent_mean"]) for row in directory.rows[:generations]]
            means.append(of_run + of_run[-1:] * (generations - len(of_run)))
        scores = np.mean(means, axis=0)
        scores[~np.isfinite(scores)] = np.nan
        train_steps = sum(summary["train_steps"] for summary in summaries)
        computed = np.mean([min(summary["generations"], generations) for summary in summaries])
        is_over = all(summary["ended"] == "solved" for summary in summaries)
        return Progress(scores, train_steps, float(computed), is_over)

    return run


def work(study: optuna.Study, plan: StudyPlan) -> None:
    """Takes trials until as many have ended as the user asks for.

    With several workers a few more may end, as a worker counts before it takes a trial.

    Raises:
      ConfigError, OSError: if a trial cannot be written.
    """
    while True:
        with contextlib.ExitStack() as held:
            with _lock(plan, "study"):
                trial = _claimed(study, plan, held)
            if trial is None:
                return
            try:
                print(f"trial {trial.number}: {_computed(trial, plan)}", flush=True)
            except Exception as error:
                mended = (ConfigError, OSError, *UNUSABLE)  # by the user, as own code is
                if not (isinstance(error, mended) or place_of(error) or platform_error()):
                    study.tell(trial, state=TrialState.FAIL)  # else every worker would die of it
                raise


def _claimed(study: optuna.Study, plan: StudyPlan, held: contextlib.ExitStack) -> Trial | None:
    """A trial whose worker is lost, or a new one, with its lock held; None if enough have ended."""
    space = {x.parameter: x.distribution for x in plan.space.values()}
    for frozen in study.get_trials(deepcopy=False, states=[TrialState.RUNNING]):
        try:
            held.enter_context(_lock(plan, _name(frozen.number), timeout=0))
        except filelock.Timeout:  # its worker is alive
            continue
        if study.get_trials(deepcopy=False)[frozen.number].state != TrialState.RUNNING:
            held.close()  # its worker has ended it meanwhile
            continue
        trial = Trial(study, frozen._trial_id)
        for name, distribution in space.items():  # the trial may lack some parameters
            trial._suggest(name, distribution)
        return trial
    known = study.get_trials(deepcopy=False)
    if sum(trial.state.is_finished() for trial in known) >= plan.config.trials:
        return None
    if not any(trial.state == TrialState.WAITING for trial in known):
        # Drawn at once: a worker killed meanwhile leaves no half trial; the next draws the same.
        seed = np.random.SeedSequence([plan.default.seed, len(known)]).generate_state(1)[0]
        draft = _copy(study)
        draft.sampler = optuna.samplers.TPESampler(seed=int(seed))
        study.enqueue_trial(draft.ask(space).params)
    trial = study.ask(space)
    held.enter_context(_lock(plan, _name(trial.number)))
    return trial


def _copy(study: optuna.Study) -> optuna.Study:
    """A copy in memory; changes to it do not change the study."""
    name = study.study_name  # the pruner draws a trial's bracket by it
    copy = optuna.create_study(study_name=name, pruner=study.pruner, direction="maximize")
    copy.add_trials(study.get_trials(deepcopy=False))
    return copy


def _is_behind(trial: Trial, rung: int) -> bool:
    """Whether a trial is pruned at a rung.

    The answer is kept before Optuna hears that the trial has reached the rung: it answers once.
    """
    name = f"pruned_at_{rung}"
    if name not in trial.user_attrs:
        copy = _copy(trial.study)
        trial.set_user_attr(name, copy.pruner.prune(copy, copy.trials[trial.number]))
    trial.should_prune()
    return bool(trial.user_attrs[name])


def _computed(trial: Trial, plan: StudyPlan) -> str:
    """Computes a trial rung by rung, until it is pruned or complete; returns a line about it."""
    study = trial.study
    overrides = plan.overrides(trial.params)
    settings = shlex.join(overrides)
    trial.set_user_attr("settings", settings)
    try:
        config = plan.trial_config(overrides)
        run = make_run(config, plan.folder / _name(trial.number), range(plan.config.seeds))
    except ConfigError as error:  # settings that cannot work together
        trial.set_user_attr("refused", str(error))
        study.tell(trial, state=TrialState.PRUNED)
        return f"refused: {error}"
    last = plan.config.max_generations
    for rung in plan.config.rungs:
        progress = run(rung)
        reported = study.get_trials(deepcopy=False)[trial.number].intermediate_values
        for step in range(len(reported) + 1, rung + 1):
            trial.report(float(progress.scores[step - 1]), step)
        if rung < last and not progress.is_over and _is_behind(trial, rung):
            break
    trial.set_user_attr("generations", progress.generations)
    trial.set_user_attr("train_steps", progress.train_steps)
    # Of a trial that was killed before it was told, the first score is kept.
    score = reported.get(rung, float(progress.scores[-1]))
    if rung == last and np.isfinite(score):
        study.tell(trial, score)
    else:
        study.tell(trial, state=TrialState.PRUNED)
    return f"{score:.4g} after {progress.generations:g} of {last} generations: {settings}"


def _name(number: int) -> str:
    return f"trials/{number:04d}"


def _lock(plan: StudyPlan, name: str, timeout: float = -1) -> filelock.FileLock:
    return filelock.FileLock(plan.folder / f"{name}.lock", timeout=timeout)


# --- results --------------------------------------------------------------------------------------


def report(study: optuna.Study, plan: StudyPlan) -> None:
    """Prints and writes the results; the best settings are tried again.

    Raises:
      OSError: if a file cannot be written.
    """
    rows = study.trials_dataframe(("number", "state", "value", "user_attrs"))
    rows = rows.rename(columns=lambda name: name.removeprefix("user_attrs_"))
    write_text(plan.folder / "trials.csv", rows.to_csv(index=False))
    best = rows[rows["state"] == "COMPLETE"]
    if best.empty:
        raise FailedError(f"No trial was completed. {plan.folder}/trials.csv says why.")
    best = best[SHOWN].sort_values(["value", "train_steps"], ascending=[False, True], kind="stable")
    table = best.head(10).to_string(index=False)
    print(f"\nThe best of {len(rows)} trials, of which {len(best)} are complete:\n{table}")
    if plan.config.verify:
        best = best.head(plan.config.verify)[["number", "value", "settings"]]
        with _lock(plan, "verification"):  # another worker may be verifying
            again = [_tried_again(study, plan, number) for number in best["number"]]
        best = best.join(pd.DataFrame(again, index=best.index))
        order = ["verified", "verified_cost"]
        best = best.sort_values(order, ascending=[False, True], kind="stable")
        write_text(plan.folder / "verification.csv", best.to_csv(index=False))
        print(f"\nThe best {len(best)}, tried again:\n{best.to_string(index=False)}")
    line = write_best(plan.overrides(study.trials[best["number"].iloc[0]].params), plan)
    print(f"\nThe best:\n  {line}\n{plan.folder} holds trials.csv, best.txt and preset.yaml.")


def _tried_again(study: optuna.Study, plan: StudyPlan, number: int) -> dict[str, float]:
    """The score of a trial's settings with seeds that no trial has had, and its generations.

    The best score of many is the luckiest too.
    """
    config = plan.trial_config(plan.overrides(study.trials[number].params))
    fresh = range(plan.config.seeds, plan.config.seeds + plan.config.fresh_seeds)
    run = make_run(config, plan.folder / f"verified/{number:04d}", fresh)
    progress = run(plan.config.max_generations)
    return {"verified": float(progress.scores[-1]), "verified_cost": progress.generations}


def write_best(overrides: Sequence[str], plan: StudyPlan) -> str:
    """Writes settings as a command and as a preset; returns the command."""
    # A preset file of a run names its folder, which holds that run.
    words = [*plan.fixed, *overrides, *(["run_dir=null"] if plan.default.run_dir else [])]
    line = shlex.join(["python", "-m", "sejax.run", *words])
    read = plan.default.in_words(LearnConfig.layers_of(words)["typed"])
    settings = {name: parsed(x) if isinstance(x, str) else x for name, x in read.items()}
    text = yaml.safe_dump(settings, sort_keys=False)
    write_text(plan.folder / "best.txt", f"{line}\n")
    write_text(plan.folder / "preset.yaml", f"# {line}\n{text}")
    return line

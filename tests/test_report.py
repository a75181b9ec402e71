"""`python -m sejax.report`: pages about runs, made of their files alone."""

import functools
import json
from html.parser import HTMLParser

import pytest
import yaml

import sejax
from sejax import report
from sejax.cli import commands
from sejax.cli import config as configuration
from sejax.cli import report as pages
from sejax.cli.run_directory import columns_of

HOSTILE = "<script>alert(1)</script>$\\frac{"


@functools.cache
def stored(*words):
    """A run's configuration as its file has it."""
    plain = configuration.plain(sejax.config([*words, "generations=3"]))
    return yaml.safe_dump(plain, sort_keys=False)


def write_run(path, *words, means=(10.0, 196.0, 150.0), ended=True, **changes):
    """The files of a run with these incumbent means."""
    path.mkdir()
    config = yaml.safe_load(stored(*words)) | changes
    (path / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    rows = [f"{i},0,{mean},{5.0},{mean - 1},{mean + 1},{max(means[: i + 1])},2000,2000,20.5,0,"
            f"{1000 * (i + 1)},{2.5 * i}" for i, mean in enumerate(means)]  # fmt: skip
    (path / "metrics.csv").write_text("\n".join([",".join(columns_of()), *rows, ""]))
    summary = {
        "ended": "finished", "generations": len(means), "solved_score": 195.0, "wall_s": 12.5,
        "train_steps": 123456, "devices": ["TFRT_CPU_0"], "machine": {"processor": "A CPU"},
        "versions": {"python": "3.11", "sejax": "0.2"},
    }  # fmt: skip
    if ended:
        (path / "run.json").write_text(json.dumps(summary))
    return path


def evaluate(path, worlds=("the proxy", "the real task")):
    rows = [f"{world},{i},{190 + i},{2000 * (place + 1)},20,False,word"
            for place, world in enumerate(worlds) for i in range(3)]  # fmt: skip
    (path / "evaluation.csv").write_text(
        "\n".join(
            ["world,agent,test_return,train_steps,train_episodes,nonfinite,activation", *rows, ""]
        )
    )


class Page(HTMLParser):
    """What a browser would see: elements with their attributes, and the text of each."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.texts, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.texts.append(data.strip())

    def of(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run with an evaluation, and the page about it."""
    run = write_run(tmp_path_factory.mktemp("whole") / "run", seed=3)
    evaluate(run)
    out = report.report([run])
    assert out == run / "report.html"
    return run, Page(out.read_text())


@pytest.mark.parametrize("value, text", [
    (0.0004, "0"), (2.9996, "3"), (1000.0001, "1,000"), (0.25, "0.25"), (12, "12"), ("x", "x"),
])  # fmt: skip
def test_numbers_have_no_trailing_point(value, text):
    assert pages.number(value) == text


def test_the_page_of_a_run_says_what_its_files_say(whole):
    run, page = whole
    for text in ("solved, after 3 of 3 generations", "196.0 ± 5.0", "195", "123,456", "A CPU",
                 "0.2", "agent.learning_rate", "the real task", "191.0 ± 1.0"):  # fmt: skip
        assert any(text in x for x in page.texts), text
    assert f"python -m sejax.evaluate proxy={run} num_agents=20" in page.texts
    again = f"python -m sejax.run preset={run}/config.yaml run_dir={run} generations=6"
    assert again in page.texts


def test_the_page_needs_nothing_else_and_says_what_figures_show(whole):
    _, page = whole
    tags = {tag for tag, _ in page.elements}
    assert not tags & {"script", "link", "img", "iframe", "object", "image"}
    ids = [x["id"] for _, x in page.elements if "id" in x]
    assert len(ids) == len(set(ids))
    for tag, attributes in page.elements:
        for name, value in attributes.items():
            assert name in ("xmlns", "xmlns:xlink") or "//" not in (value or ""), (tag, name)
            assert name not in ("href", "xlink:href") or value[1:] in ids
    figures = page.of("figure")
    assert len(figures) == 2 and all(x["role"] == "img" and x["aria-label"] for x in figures)
    assert page.of("html")[0]["lang"] == "en" and page.of("meta")


def test_what_differs_between_runs_comes_first(tmp_path):
    runs = [write_run(tmp_path / f"seed{i}", seed=i) for i in range(3)]
    rows = pages.settings(pages.read(runs))
    assert rows[0] == ("seed", ["0", "1", "2"], True)
    assert not any(differs for _, _, differs in rows[1:])


def test_what_comes_from_files_is_text(tmp_path, monkeypatch):
    run = write_run(tmp_path / f"_{HOSTILE.replace('/', '')}", preset=HOSTILE)
    evaluate(run, worlds=(HOSTILE, f"_{HOSTILE}"))
    summary = json.loads((run / "run.json").read_text())
    summary["versions"] = {HOSTILE: HOSTILE}
    (run / "run.json").write_text(json.dumps(summary))
    other = write_run(tmp_path / "b", env={"name": HOSTILE})
    monkeypatch.chdir(tmp_path)
    text = report.report([run, other]).read_text()
    assert "<script" not in text
    page = Page((tmp_path / "report.html").read_text())
    assert any(HOSTILE in x for x in page.texts) and "2 runs compared" in page.texts
    assert len(page.of("figure")) == 4
    assert [x.get("class") for x in page.of("tr")].count("differs") == 2  # preset and env.name


def test_a_run_that_goes_on_is_told_as_such_and_long_tables_are_thinned(tmp_path):
    means = [float(i) for i in range(1000)]
    (read,) = pages.read([write_run(tmp_path / "run", means=means, ended=False)])
    assert read.title.startswith("not ended: 1000 of 3") and "solved at" not in read.facts
    assert read.environment == {} and read.solved_score is None
    assert "Go on, to generation 3" in dict(read.commands)
    assert 50 <= len(read.thinned) <= pages.MOST_ROWS
    assert read.thinned[-1]["generation"] == "999"


def test_nothing_that_a_file_names_is_imported(tmp_path, monkeypatch):
    (tmp_path / "mine_for_reports.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    run = write_run(tmp_path / "run", env={"name": "mine_for_reports:make"})
    ((_, command),) = pages.read([run])[0].commands
    assert "env=mine_for_reports:make" in command


HEADER = ",".join(columns_of()) + "\n"
GENERATION = "0,0,1,1,1,1,1,1,1,1,0,1,1\n"
DAMAGE = [
    *(("metrics.csv", text) for text in (
        None, "", HEADER, "generation\n1\n", HEADER + GENERATION[:-1] + ",9\n",
        *(HEADER + GENERATION.replace("0", each, 1) for each in ("nan", "inf", "9" * 400, "x")),
        "\udcff",
    )),
    *(("config.yaml", text) for text in (
        None, "", "- 1", "a: [", "a: " + "[" * 5000, "seed: &a [*a]", "? [1, 2]\n: 5",
        "a: !!python/object/apply:os.system [id]", "generations: .inf", "agents: [1]",
        "agent: ddqn",
    )),
    *(("run.json", text) for text in (
        "[", "3", "null", "[" * 100_000, '{"solved_score": {}}', f'{{"cpu_s": {"9" * 500}}}',
    )),
    *(("evaluation.csv", text) for text in (
        "test_return,train_steps,train_episodes\n1,2,3\n", "world,agent,test_return\nw,0,x\n",
    )),
]  # fmt: skip


def test_odd_folders_are_refused_with_one_short_message(tmp_path, capsys):
    """Findings F7: a folder without a run, a file, a path that is not there, and damaged runs."""

    def said(*words):
        with pytest.raises(SystemExit) as ended:
            report.main([str(word) for word in words])
        error = capsys.readouterr().err
        assert ended.value.code == commands.BAD_INPUT and error.count("\n") == 1
        assert len(error) < 400 + len(str(tmp_path))
        return error

    run = write_run(tmp_path / "run")
    (tmp_path / "file").write_text("")
    for folder in (tmp_path, tmp_path / "file", tmp_path / "absent", "/proc/x", "a\0b", "d" * 9999):
        assert said(folder).startswith("error: RUN_DIR must be")
    assert said(run, tmp_path / "absent").startswith("error: RUN_DIR must be")
    assert said().startswith("error: RUN_DIR must be")
    assert said(run, f"out={tmp_path}").startswith("error: out must be")
    for name, text in DAMAGE:
        kept = (run / name).read_text() if (run / name).exists() else None
        if text is None:
            (run / name).unlink()
        else:
            start = kept if name == "config.yaml" and text[:1].isalpha() else ""
            (run / name).write_text(f"{start}{text}", errors="surrogateescape")
        assert said(run).startswith("error: RUN_DIR must be"), text[:50]
        if kept is None:
            (run / name).unlink()
        else:
            (run / name).write_text(kept)
    assert not (run / "report.html").exists()


def test_odd_values_that_can_be_shown_are_shown(tmp_path):
    run = write_run(tmp_path / "run", seed=[1, {"a": None}])
    (run / "run.json").write_text('{"generations": true, "machine": {"cpu": "\\ud800"}}')
    (run / "evaluation.csv").write_text("world,agent,test_return,train_steps,train_episodes\n")
    text = report.report([run]).read_text()
    assert "\\ud800" in text and "not ended" in text


def test_help_says_how_to_use_it(capsys):
    report.main(["--help"])
    assert "python -m sejax.report RUN_DIR..." in capsys.readouterr().out

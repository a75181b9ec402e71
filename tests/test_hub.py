"""Proxies on the Hugging Face Hub, which is a dictionary here."""

import inspect
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import yaml
from safetensors.numpy import save
from support import evaluation, paper_se, refusal, refused

import sejax
from sejax.proxies import header, hub
from sejax.runs.fresh_agents import worlds_of

SHIPPED = header.PRETRAINED_DIR / "cartpole.safetensors"


class FakeHub:
    """The functions of `huggingface_hub` that are used.

    Attributes:
      commits: the files of each repository after each commit; the last commit is the branch `main`.
      sizes: what files are said to have, by name; those they have if they are not there.
      private: how repositories were made.
    """

    __spec__ = True  # it is installed

    def __init__(self, folder):
        self.folder, self.commits, self.sizes, self.private = folder, {}, {}, {}
        self.HfApi = lambda: self
        self.CommitOperationAdd = lambda *operation: operation

    def hf_hub_download(self, repo_id, filename, *, revision=None, dry_run=False):
        if repo_id not in self.commits:
            raise OSError(f"404 Client Error: {repo_id}\nRepository Not Found " + "x" * 500)
        content = self.commits[repo_id][int(revision or -1)][filename]
        if dry_run:
            return SimpleNamespace(file_size=self.sizes.get(filename, len(content)))
        path = self.folder / f"{repo_id}@{revision}".replace("/", "_") / filename
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_bytes(content)
        return str(path)

    def create_repo(self, repo_id, *, private, exist_ok):
        assert exist_ok
        self.private.setdefault(repo_id, private)

    def create_commit(self, repo_id, operations, *, commit_message):
        self.commits.setdefault(repo_id, []).append(dict(operations))


@pytest.fixture
def the_hub(monkeypatch, tmp_path):
    """An empty Hub."""
    fake = FakeHub(tmp_path / "cache")
    monkeypatch.setitem(sys.modules, "huggingface_hub", fake)
    return fake


def test_the_functions_of_the_library_take_these_arguments():
    library = pytest.importorskip("huggingface_hub", reason="needs pip install 'sejax[hub]'")
    bind = inspect.signature(library.hf_hub_download).bind
    bind("me/se", "proxy.safetensors", revision="v1", dry_run=True)
    inspect.signature(library.HfApi.create_repo).bind(None, "me/se", private=True, exist_ok=True)
    inspect.signature(library.HfApi.create_commit).bind(None, "me/se", [], commit_message="")
    inspect.signature(library.CommitOperationAdd).bind("README.md", b"")


# --- addresses -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("address", "parts"), [
    ("hf://me/my-se", ("me/my-se", None, "proxy.safetensors")),
    ("hf://me/my.se@v1.0", ("me/my.se", "v1.0", "proxy.safetensors")),
    ("hf://me/se@refs/pr/3/a/b.safetensors", ("me/se", "refs/pr/3", "a/b.safetensors")),
    ("hf://me/se/last.safetensors", ("me/se", None, "last.safetensors")),
])  # fmt: skip
def test_an_address_names_repository_revision_and_file(address, parts):
    assert hub.parse(address) == parts


@pytest.mark.parametrize("address", [
    "hf://", "hf://me", "hf://me/", "hf://me/se/", "hf://me/se/pytorch_model.bin",
    "hf://me/se/proxy.pkl", "hf://me/se/../../x.safetensors", "hf://../se", "hf://me/se@",
    "hf://" + "/" * 100,
    "hf://me/se/" + "a/" * 100 + "x.safetensors", "hf://me/se/.hidden.safetensors",
    "hf://me/se/proxy.safetensors\n", "hf://datasets/me/se",
])  # fmt: skip
def test_what_is_no_address_or_no_safetensors_file_is_refused(address):
    assert refused(hub.parse, address, "proxy") == "proxy"


@pytest.mark.parametrize("repo", ["s", "a/b/c", "hf://a/b", "a/..", "", None, 3, "a/" + "x" * 500])
def test_a_repository_has_an_owner_and_a_name(repo):
    assert refused(sejax.push, "cartpole", repo) == "repo"


def test_a_missing_extra_is_one_line_that_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert ".[hub]" in str(refusal(sejax.load, "hf://me/se"))
    assert ".[hub]" in str(refusal(sejax.push, "cartpole", "me/se"))


# --- what is pushed and loaded -------------------------------------------------------------------


def test_a_proxy_that_is_pushed_is_loaded_everywhere_as_it_was(the_hub):
    address = sejax.push("cartpole", "me/my-cartpole", private=True)
    assert address == "hf://me/my-cartpole" and the_hub.private == {"me/my-cartpole": True}
    (files,) = the_hub.commits["me/my-cartpole"]
    assert sorted(files) == ["README.md", "proxy.safetensors"]
    assert files["proxy.safetensors"] == SHIPPED.read_bytes()
    proxy, shipped = sejax.load_proxy(address), sejax.load_proxy("cartpole")
    assert proxy.env.config == shipped.env.config and proxy.task is shipped.task
    assert proxy.fingerprint == shipped.fingerprint == sejax.load_set(address)[0].fingerprint
    pytest.importorskip("gymnasium")
    envs = [sejax.gym.make(source) for source in (address, "cartpole")]
    np.testing.assert_array_equal(*(env.reset(seed=3)[0] for env in envs))


def test_a_run_directory_is_pushed_and_a_card_says_what_is_known_of_it(the_hub, tmp_path):
    env, params = sejax.load("pendulum")
    config = {"agents": {"sac": {"name": "sac"}}}
    record = {"score": -150.0, "generation": 7, "seed": 2}
    sejax.save(tmp_path / "proxy.safetensors", env, params.weights, config, **record)
    sejax.push(tmp_path, "me/swing-up", license="mit")
    front, card = front_and_card(the_hub, "me/swing-up")
    assert front == {
        "library_name": "sejax", "license": "mit", "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "jax", "synthetic-environment", "pendulum"],
    }  # fmt: skip
    assert card.startswith("# swing-up\n") and card.endswith("## License\n\nmit")
    for said in ("generation: 7", "seed: 2", "scores:\n  sac: -150.0", "sejax[hub]",
                 'sejax.load("hf://me/swing-up")', 'sejax.gym.make("hf://me/swing-up")',
                 "proxy=hf://me/swing-up`"):  # fmt: skip
        assert said in card
    assert "What it teaches" not in card and "None" not in card


def test_a_shipped_ones_card_keeps_what_it_teaches(the_hub):
    sejax.push("cliff_walking-rn", "me/rn")
    front, card = front_and_card(the_hub, "me/rn")
    assert "reward-network" in front["tags"] and front["license"] == "apache-2.0"
    (shipped,) = (proxy for proxy in sejax.pretrained() if proxy.name == "cliff_walking-rn")
    rows = [line for line in shipped.card.splitlines() if line.startswith("| q_learning")]
    assert rows and all(row in card for row in rows) and "sejax.gym.make" not in card


def front_and_card(the_hub, repo):
    empty, front, card = the_hub.commits[repo][-1]["README.md"].decode().split("---\n", 2)
    assert not empty
    return yaml.safe_load(front), card.lstrip()


def test_ones_own_task_is_to_be_given(the_hub, tmp_path):
    task = sejax.Task(name="my\x1b", env=sejax.envs.make("cartpole").env, max_steps=10)
    env = paper_se(hidden_size=2).make(task)
    sejax.save(tmp_path / "mine.safetensors", env, env.init_weights(jax.random.key(0)))
    address = sejax.push(tmp_path / "mine.safetensors", "me/mine")
    _, card = front_and_card(the_hub, "me/mine")
    assert all(x in card for x in ('sejax.load("hf://me/mine", task=...)', "env=...", r"`my\x1b`"))
    assert sejax.load(address, task=task)[0].task is task


def test_a_revision_is_what_was_then_and_none_is_what_is_now(the_hub):
    address = sejax.push("cartpole", "me/se")
    sejax.push("acrobot", "me/se")
    assert sejax.load_proxy(f"{address}@0").task.name == "cartpole"
    assert sejax.load_proxy(address).task.name == "acrobot"


# --- what can go wrong ---------------------------------------------------------------------------


def test_a_set_is_not_pushed(the_hub, tmp_path):
    env, params = sejax.load("cartpole")
    sejax.save_set(tmp_path / "set.safetensors", env, [params.weights] * 2, [{}, {}])
    assert refused(sejax.push, tmp_path / "set.safetensors", "me/set") == "source"
    assert not the_hub.commits


def test_what_cannot_be_read_or_written_is_one_message(the_hub, monkeypatch):
    the_hub.commits = {
        "me/large": [{"proxy.safetensors": SHIPPED.read_bytes()}],
        "me/pickle": [{"proxy.safetensors": b"\x80\x04cos\nsystem\n(S'true'\ntR."}],
        "me/foreign": [{"proxy.safetensors": save({"x": np.zeros(2, np.float32)})}],
    }
    for repo in ("nothing", "pickle", "foreign"):
        assert refused(sejax.load, f"hf://me/{repo}") == "source"
    the_hub.sizes = {"proxy.safetensors": hub.MAX_BYTES + 1}
    assert refused(sejax.load, "hf://me/large") == "source"
    assert not [*the_hub.folder.glob("me_large*")], "nothing of it is fetched"
    monkeypatch.delattr(FakeHub, "create_commit")
    assert refused(sejax.push, "cartpole", "me/se") == "repo"


def test_the_command_evaluates_what_is_there_and_writes_in_the_working_folder(the_hub):
    sejax.push("cartpole", "me/se")
    config = evaluation(["proxy=hf://me/se@0"])
    assert str(config.folder) == "runs/evaluate-me_se_0"
    assert {world.task.name for world in worlds_of(config).values()} == {"cartpole"}

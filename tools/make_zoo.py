"""Writes docs/zoo.md: a table of the proxies that ship with the package, and the card of each.

python tools/make_zoo.py
"""

import re
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

import sejax
from sejax.ops.files import write_text
from sejax.proxies.zoo import table

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "zoo.md"
TESTED = "results/se_myopia/*"

HEAD = """\
# The zoo

Proxies that ship with the package. `sejax.load("cartpole")` loads one as a gymnax environment,
`sejax.gym.make("cartpole")` a synthetic environment (`se`) for Gymnasium. `sejax.pretrained()`
lists them with all that stands here. `python tools/make_zoo.py` makes this page of their files;
`python tools/ship_proxy.py --help` says how one gets into the package.

*Return* and *steps* are from the lowest to the highest of the kinds of agents that were trained on
the proxy and tested on the real task: the mean return there, and how long an agent trained.
*Teaches by* is the verdict on an SE of [the myopia test](results.md#the-myopia-test): `policy` if
agents that look at the next reward alone learn as well, `dynamics` if only far-sighted ones learn.

Those called *distilled* were not evolved: each is [made of a searched policy](distill.md), which
is all that it teaches, and stands beside the evolved SE of its task. Of three such runs with three
seeds the one that ships taught those students best by which a run chooses its SE; what it is said
to teach was measured on others.

Costs are those of the one run that ships, often the best of several: `cartpole` of five,
`cartpole-rn` of ten, `cliff_walking-rn` of fifty, `mountain_car_continuous-rn` of five, by their
scores or, for `cartpole`, by the returns of discrete TD3. What `cartpole_v1`,
`acrobot`, `mountain_car` and `mountain_car_continuous` were chosen from is not stored.
`halfcheetah` is the first of three runs; `halfcheetah-rn` is the one run of its variant.
`pendulum` is the second of two settings that were tried, one run each.

The second table of each tells what fresh agents reach that trained for the steps given and were
then tested on the real task: mean and standard deviation of the agents' mean returns.

Each is used in the same way, here `acrobot`:

```python
import sejax

env = sejax.gym.make("acrobot")  # a gymnasium.Env of an SE, in NumPy: any agent, no JAX
env, params = sejax.load("acrobot")  # a gymnax environment, in JAX
```

`python -m sejax.evaluate proxy=acrobot agent=sac` trains agents on it and tests them on the real
task. Those of MuJoCo's tasks need `pip install 'sejax[mujoco]'`. All are sejax's own, under
Apache-2.0, and hold no data of others.

"""


def page() -> str:
    """The text of the page."""
    proxies = sejax.pretrained()
    tested = verdicts()
    rows = [row(proxy, tested) for proxy in proxies]
    return HEAD + "\n\n".join([table(rows), *map(section, proxies)])


def verdicts() -> dict[str, str]:
    """What the myopia test says of each shipped SE that it was made on, by its name.

    Not of a proxy that was learned anew since.
    """
    names = {f"{proxy.name} (shipped)": proxy.name for proxy in sejax.pretrained()}
    found = {}
    for folder in ROOT.glob(TESTED):
        rows = pd.read_csv(folder / "rows.csv.xz", low_memory=False)
        tested = rows[rows["set"].isin(names)]
        lines = (folder / "table.md").read_text(encoding="utf-8").splitlines()
        cells = [line.strip("| ").split(" | ") for line in lines]
        verdicts = {each[0]: each[-1] for each in cells}
        for key, fingerprint in zip(tested["set"], tested["group"], strict=True):
            if sejax.load_proxy(names[key]).fingerprint == fingerprint:
                found[names[key]] = verdicts[key]
    return found


def row(proxy: sejax.PretrainedProxy, verdicts: Mapping[str, str]) -> dict[str, str]:
    """A proxy's row of the table."""
    name, kind, *others = proxy.row.items()
    linked = {"name": f"[{proxy.name}](#{proxy.name})"}
    teaches_by = "policy" if proxy.is_distilled else verdicts.get(proxy.name, "")
    return dict([name, kind, ("teaches by", teaches_by), *others]) | linked


def section(proxy: sejax.PretrainedProxy) -> str:
    """What a card says of this proxy alone: its facts, what it teaches and how it was learned."""
    title, *sections = re.split(r"\n\n(?=## )", proxy.card)
    name, _, facts = title.split("\n\n", 2)
    kept = [f"#{name}", facts]
    for text in sections:
        heading, _, body = text.partition("\n\n")
        if heading == "## What it teaches":
            kept.append(body.partition("\n\n")[2])
        elif heading == "## How it was learned":
            kept.append(f"Learned by:\n\n{body}")
    return "\n\n".join(kept)


if __name__ == "__main__":
    write_text(PAGE, page())
    print(f"{PAGE} has {len(sejax.pretrained())} proxies.")

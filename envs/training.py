"""The command that trains a network and ships it: what the `train_*` scripts share.

sys.exit(Training(task, PPO(...), "cart-pole", steps=500_000, ...).main(__doc__))
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

from verifai_jax.addons.rl import PPO, Task, evaluate, save_policy, train


@dataclass(frozen=True)
class Training:
    """A task, the options of its training, and the return at which it counts as learned.

    - `steps`, `seed`: of the network that is shipped in `file`.
    - `solved`: the mean return to reach, of at most `maximum`, over `episodes` that it was not
      trained on.
    """

    task: Task
    hyper_parameters: PPO
    name: str
    file: Path
    steps: int
    solved: float
    maximum: int
    seed: int = 0
    episodes: int = 1000

    def main(self, about: str | None, arguments: list[str] | None = None) -> int:
        """Train, measure, write the weights, and return the exit status."""
        parser = argparse.ArgumentParser(
            description=about, formatter_class=argparse.RawTextHelpFormatter
        )
        parser.add_argument("--seed", type=int, default=self.seed)
        parser.add_argument("--steps", type=int, default=self.steps, help="environment steps")
        parser.add_argument("--out", type=Path, default=self.file)
        chosen = parser.parse_args(arguments)

        started = time.perf_counter()
        trained = train(self.task, self.hyper_parameters, seed=chosen.seed, steps=chosen.steps)
        seconds = time.perf_counter() - started
        returns = evaluate(self.task, trained.policy, seed=chosen.seed + 1, episodes=self.episodes)
        mean_return = float(returns.mean())
        print(
            f"{trained.steps[-1]} steps in {seconds:.1f} s, compile included; "
            f"mean return {mean_return:.1f} of {self.maximum}, "
            f"worst {returns.min():.0f} of {len(returns)} episodes"
        )
        if mean_return < self.solved:
            print(f"not solved: the mean return must reach {self.solved:g}; nothing written")
            return 1
        save_policy(
            trained.policy,
            chosen.out,
            task=self.name,
            algorithm="PPO",
            seed=chosen.seed,
            steps=int(trained.steps[-1]),
            mean_return=mean_return,
        )
        print(f"wrote {chosen.out}")
        return 0

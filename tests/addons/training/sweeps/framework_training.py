"""Trainers of other frameworks: PPO of Stable-Baselines3 and PPO of Brax."""

import jax
import jax.numpy as jnp

import verifai_jax as vj


def sb3_ppo(key, hyperparameters, steps, resume):
    import gymnasium
    import stable_baselines3 as sb3

    env = gymnasium.make("Pendulum-v1")
    file = resume / "model.zip"
    if file.exists():
        model = sb3.PPO.load(file, env=env)
    else:
        seed = int(jax.random.key_data(key)[-1])
        model = sb3.PPO(
            "MlpPolicy", env, seed=seed, n_steps=64, policy_kwargs={"net_arch": [8]},
            **hyperparameters,
        )  # fmt: skip
    model.learn(steps - model.num_timesteps, reset_num_timesteps=False)
    model.save(file)
    return model


def brax_ppo(key, hyperparameters, steps, resume):
    from brax import envs
    from brax.training.agents.ppo import networks, train
    from flax import serialization

    # Brax 0.14 calls what JAX 0.10 has taken out.
    jax.device_put_replicated = lambda tree, devices: jax.tree.map(
        lambda leaf: jnp.stack([leaf] * len(devices)), tree
    )
    file = resume / "weights"
    made = networks.make_ppo_networks(4, 1, policy_hidden_layer_sizes=(8,))
    begun = None
    if file.exists():
        begun = serialization.msgpack_restore(file.read_bytes())
    make, weights, _ = train.train(
        envs.get_environment("inverted_pendulum", backend="spring"),
        num_timesteps=steps, episode_length=50, num_envs=8, batch_size=8, num_minibatches=2,
        unroll_length=5, num_evals=1, num_eval_envs=4, network_factory=lambda *_, **__: made,
        seed=int(jax.random.key_data(key)[-1]), run_evals=False, **hyperparameters,
        restore_params=None if begun is None else as_weights(begun),
    )  # fmt: skip
    file.write_bytes(serialization.msgpack_serialize(serialization.to_state_dict(weights)))
    infer = make(weights, deterministic=True)
    return lambda observation: infer(observation, jax.random.key(0))[0]


def as_weights(begun):
    from brax.training.acme import running_statistics, specs
    from brax.training.agents.ppo import networks
    from flax import serialization

    made = networks.make_ppo_networks(4, 1, policy_hidden_layer_sizes=(8,))
    key = jax.random.key(0)
    scale = running_statistics.init_state(specs.Array((4,), jnp.dtype("float32")))
    like = (scale, made.policy_network.init(key), made.value_network.init(key))
    return serialization.from_state_dict(like, begun)


def pendulum(policy):
    def system(features, key):
        def step(state, _):
            angle, speed = state
            seen = jnp.stack([jnp.cos(angle), jnp.sin(angle), speed])
            torque = policy.act(seen)[0]
            speed = speed + 0.05 * (15.0 * jnp.sin(angle) + 3.0 * torque)
            angle = angle + 0.05 * speed
            return (angle, speed), angle

        _, angles = jax.lax.scan(step, (features["angle"], jnp.zeros(())), None, length=40)
        return vj.Trace({"angle": angles}, dt=0.05)

    return vj.Problem("stay_up", {"angle": vj.Box(-1.0, 1.0)}, system, "always abs(angle) < 3")


def pole(policy):
    system = vj.gymnax(
        "CartPole-v1", lambda o: (policy.act(o)[0] > 0).astype(int), initial={"theta0": "theta"},
        steps=40,
    )  # fmt: skip
    return vj.Problem("pole", {"theta0": vj.Box(-0.1, 0.1)}, system, "always abs(theta) < 0.2")


STUDIES = {"sb3": (sb3_ppo, pendulum, 3, 128), "brax": (brax_ppo, pole, 4, 320)}


def sweep(name, folder):
    train, problem, size, steps = STUDIES[name]
    trainer = vj.Trainer(
        train, steps=steps, example=lambda o: jnp.zeros(1), observation=jnp.zeros(size)
    )
    study = vj.Study(
        name, {"learning_rate": vj.LogUniform(1e-4, 1e-2)}, trainer, problem,
        checkpoints=(steps // 2,),
    )  # fmt: skip
    return vj.sweep(
        study,
        "halton",
        2,
        certification=vj.Certification(samples=64, attack_simulations=0),
        folder=folder,
        progress=False,
    )

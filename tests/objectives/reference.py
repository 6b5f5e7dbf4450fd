"""Independent reference of the paper's formulas, in Python floats and loops."""

import math

LOG_2PI = math.log(2 * math.pi)


def layers(params, member=None):
    """The (weight, bias) lists of a network's parameters, first layer first."""
    leaves = sorted(params.items(True, True), key=lambda item: item[0])
    tensors = [value.detach() if member is None else value.detach()[member] for _, value in leaves]
    biases, weights = tensors[0::2], tensors[1::2]
    return [(w.tolist(), b.tolist()) for w, b in zip(weights, biases, strict=True)]


def mlp(network, x):
    for depth, (weight, bias) in enumerate(network):
        x = [sum(w * v for w, v in zip(row, x, strict=True)) + b for row, b in zip(weight, bias, strict=True)]
        if depth < len(network) - 1:
            x = [max(v, 0.0) for v in x]
    return x


def policy(network, observation, noise):
    """a = tanh(loc + exp(log_std) noise) and log pi(a), by the change of variables."""
    out = mlp(network, observation)
    size = len(out) // 2
    action, log_prob = [], 0.0
    for loc, log_std, eps in zip(out[:size], out[size:], noise, strict=True):
        a = math.tanh(loc + math.exp(log_std) * eps)
        action.append(a)
        log_prob += -0.5 * eps**2 - log_std - 0.5 * LOG_2PI - math.log(1 - a**2)
    return action, log_prob


def mean(values):
    return sum(values) / len(values) if values else 0.0


def value_penalty(name, y, parameter):
    if name == "expectile":
        return abs(parameter - (1 if y < 0 else 0)) * y**2
    if name == "sparse":
        inner = 1 + y / (2 * parameter)
        return (inner**2 if inner > 0 else 0.0) - y / parameter
    return math.exp(y / parameter) - y / parameter


def mixed_target(row, mixing, gamma, alpha, actor, target_qvalues, value, noise):
    """Eq. (7)."""
    if row["terminated"]:
        return row["reward"]
    action, log_prob = policy(actor, row["next_observation"], noise)
    q = min(mlp(q, row["next_observation"] + action)[0] for q in target_qvalues)
    v = mlp(value, row["next_observation"])[0]
    return row["reward"] + mixing * gamma * v + (1 - mixing) * gamma * (q - alpha * log_prob)


def discriminator_probability(network, inputs, bound, added=(0.0, 0.0)):
    """p(real) of a two-way softmax over bounded logits."""
    logits = [z + extra for z, extra in zip(bounded(mlp(network, inputs), bound), added, strict=True)]
    return math.exp(logits[0]) / (math.exp(logits[0]) + math.exp(logits[1]))


def bounded(logits, bound):
    return [z if bound is None else bound * math.tanh(z) for z in logits]


def rows(batch):
    return [
        {
            "observation": r["observation"].tolist(),
            "action": r["action"].tolist(),
            "real": bool(r["real"]),
            "reward": r["next", "reward"].item(),
            "terminated": bool(r["next", "terminated"]),
            "next_observation": r["next", "observation"].tolist(),
        }
        for r in batch
    ]

"""Variants of the tracker's configuration: the default, the paper's, and the default without one of its parts."""

from __future__ import annotations

from dataclasses import replace

from ddakf.config import Config


def ablations() -> dict[str, Config]:
    """The default without each of its five changes to the paper's method, one at a time."""
    default = Config()
    association = default.associate
    blind = replace(association, facing_cosine=-1.0, normal_cosine=-1.0, hidden_depth=100.0)
    once = replace(association, iterations=1, slow_iterations=1, least_iterations=1)
    alone = replace(default.physics, motion_rigidity=0.0, rest_rigidity=0.0, uneven_rigidity=0.0)
    return {
        "no-planes": replace(default, associate=replace(association, tangential_sd=default.adapt.initial_sd)),
        "one-association": replace(without_clusters(), associate=once),
        "no-visibility": replace(default, associate=blind),
        "no-correlation": replace(default, physics=alone),
        "no-carrying": replace(default, predict=replace(default.predict, carry_reach=0.0)),
    }


def refinements() -> dict[str, Config]:
    """The default without each of the additions beyond the five changes, one at a time."""
    default = Config()
    return {
        "no-softening": replace(default, physics=replace(default.physics, strain_sd=1e3)),
        "no-clusters": without_clusters(),
        "no-hems": replace(default, associate=replace(default.associate, hem_reach=0.0)),
        "no-holding": replace(default, anchor=replace(default.anchor, memory=0.0)),
        "no-following": replace(default, follow=replace(default.follow, reach=0.0)),
        "no-weight": replace(default, physics=replace(default.physics, weight=0.0)),
    }


def without_clusters() -> Config:
    """The default with passes over all vertices only, without cluster alignment."""
    default = Config()
    return replace(default, coarse=replace(default.coarse, iterations=0))

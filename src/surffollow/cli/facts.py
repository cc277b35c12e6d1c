"""How commands print the facts of a result."""

from __future__ import annotations

import json
from typing import Any

import click

from surffollow.units import numbers_text


def print_facts(facts: dict[str, Any], as_json: bool, digits: int = 6) -> None:
    """Print one JSON object, or a line per fact.

    Parameters
    ----------
    facts : dict
        name → number, text, list of numbers, or a list of dictionaries of a survey
    as_json : bool
        print the object
    digits : int
        significant digits of numbers in lines, beyond the thousandths that all have
    """
    if as_json:
        click.echo(json.dumps(facts))
        return
    width = max(map(len, facts))
    for key, value in facts.items():
        if isinstance(value, float):
            value = numbers_text(value, digits=digits)
        elif isinstance(value, dict):
            value = ", ".join(f"{k} {v}" for k, v in value.items() if v) or "none"
        elif isinstance(value, (list, tuple)) and value and isinstance(value[0], dict):
            for one in value:
                if "median_m" in one:
                    click.echo(
                        f"{one['name']:<{width}}  {one['cells']} cells in both, median difference "
                        f"{1e3 * one['median_m']:.1f} mm, RMS {1e3 * one['rms_m']:.1f} mm"
                    )
                    continue
                patches = ", ".join(f"{n} {k}" for k, n in one.get("patches", {}).items() if n)
                click.echo(f"{one.get('name', key):<{width}}  patches: {patches}")
            continue
        elif isinstance(value, (list, tuple)):
            value = " ".join(numbers_text(v, digits=digits) for v in value)
        click.echo(f"{key:<{width}}  {'-' if value is None else value}")

"""Signatures of all kernels: at most eight arguments, and a docstring."""

import importlib
import inspect
import pkgutil

import pytest
from numba.core.dispatcher import Dispatcher

from ddakf import kernels

MODULES = [importlib.import_module(f"ddakf.kernels.{module.name}") for module in pkgutil.iter_modules(kernels.__path__)]
KERNELS = {
    f"{module.__name__}.{name}": value.py_func
    for module in MODULES
    for name, value in vars(module).items()
    if isinstance(value, Dispatcher) and value.py_func.__module__ == module.__name__
}


@pytest.mark.parametrize("name", KERNELS)
def test_a_kernel_has_at_most_eight_arguments_and_says_them(name):
    assert len(inspect.signature(KERNELS[name]).parameters) <= 8
    assert KERNELS[name].__doc__

"""Find the tables of all studies."""

import importlib
import pkgutil

from experiments import studies
from experiments.paper_tables.tables import Table


def study_tables():
    """Every ``Table`` of a module of ``experiments.studies``."""
    names = [module.name for module in pkgutil.iter_modules(studies.__path__)]
    modules = [importlib.import_module(f"{studies.__name__}.{name}") for name in names]
    return [value for module in modules for value in vars(module).values() if isinstance(value, Table)]

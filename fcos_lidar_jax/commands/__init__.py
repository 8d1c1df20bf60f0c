"""What the command line does, one module a command: a frozen dataclass of arguments and ``run``."""

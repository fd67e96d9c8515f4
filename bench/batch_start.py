"""How long a command takes until it begins: seconds of the processor, modules, and which libraries among them."""


def start() -> list[str]:
    return []

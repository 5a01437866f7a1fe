"""An option that holds one value may be given once: of two, the last would win without a word."""

from collections import Counter

import typer
from typer.core import TyperCommand, TyperOption


class _Command(TyperCommand):
    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        _, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for option, times in Counter(given).items():
            if times > 1 and isinstance(option, TyperOption) and not _may_repeat(option):
                name = max(option.opts, key=len)
                ctx.fail(f"{name} is given {'twice' if times == 2 else f'{times} times'} and holds one value: keep one of them")
        return super().parse_args(ctx, args)


def _may_repeat(option: TyperOption) -> bool:
    """Whether the option collects values, or says the same each time, as --force does."""
    return option.multiple or option.count or (option.is_flag and not option.secondary_opts)


def refuse_repeated(app: typer.Typer) -> None:
    """Have every command of the app, those in groups too, refuse an option that is given twice."""
    for command in app.registered_commands:
        command.cls = _Command
    for group in app.registered_groups:
        if group.typer_instance is not None:
            refuse_repeated(group.typer_instance)

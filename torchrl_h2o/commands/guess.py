GUESS = "--guess"


def guess_columns(a): ...

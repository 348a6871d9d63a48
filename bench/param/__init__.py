"""Parameters of a drive that can be trusted: told, compared, kept in a file, written whole or not at all.

`table` is what is known of parameters, whoever tells it (`sources`): a drive, a dump (`dump`), a recorded run.
`differences` compares two. `writing` sets and puts back, `loading` writes a dump, `history` keeps why something was
changed, and `watching` tells what changes.
"""

"""The health of Hall sensors: where their edges lie, what is wrong with them or their wires, in words with numbers.

`live` turns the motor and records, `trace` reads what was recorded, `edges`, `pulses` and `reference` measure, `health`
says what it means, `report` shows it, and `learn` hands the edges to the drive. All but `live` and `learn` take
recordings and live captures alike and never talk to a drive.
"""

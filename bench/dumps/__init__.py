"""What other tools store of a motor: VESC Tool's XML, ODrive's JSON, the text of moteus_tool.

read         a file of theirs as names and values; nothing in it is trusted
motor        the motor that one describes, or a data sheet, as a configuration of the simulated drive

What such a file says of Hall sensors is read by `bench.hall.tables`. Names and units are from the tools' sources:
vedderb/bldc and vesc_tool, odriverobotics/ODrive, mjbots/moteus.
"""

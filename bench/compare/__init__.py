"""Two recorded runs laid over each other.

alignment   the tick of a run that is time 0: its begin, a mark, an event
batches     means over batches of time: differences and how sure they are
said        events and parameters that differ
compare     all of it, as rows
"""

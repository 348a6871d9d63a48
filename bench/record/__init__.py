"""The stored form of a run: a folder of Parquet files, a log, and the journal of what is in no file yet.

    info       what is known of a run: drive, channels, parameters, marks
    layout     names of files, Arrow schemas, checksums; chunks to tables and back
    journal    the newest minute as it comes, readable up to the last whole frame after kill -9
    overview   minima and maxima of every channel, so that hours can be looked at
    writer     chunks, events, marks in; files out: the one way from a sample to the disk
    sink       the writer on a thread of its own, for a client
    reader     the run back, any part of it, every block verified

A run is complete at every moment: what is in no Parquet file yet is in the journal, and everything else stands in the
log, one JSON object a line. Every line, every frame of the journal and every block of a Parquet file has a CRC-32.
"""

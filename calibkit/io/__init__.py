"""Files in and out: recordings, images, rig files, other tools' formats. Conventions flip only here."""

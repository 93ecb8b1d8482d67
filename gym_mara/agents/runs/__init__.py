"""Run folders: their files, the policies in them, and the evaluation of those."""

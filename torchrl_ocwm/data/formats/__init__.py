"""Episodes in the formats of others, to be read (:func:`open_source`)."""

from torchrl_ocwm.data.formats.source import FORMATS, Source, SourceError, open_source

__all__ = ["FORMATS", "Source", "SourceError", "open_source"]

"""Whole programs of controllers: their points read and corrected, everything else byte for byte."""

"""Sentences of certificates."""

from dataclasses import fields

import pytest

from fmu.fem.certificates import SurrogateCertificate


@pytest.mark.parametrize(
    ("shift", "found"), [(0.0123, "0.012"), (0.0003, "0.0003"), (2e-7, "2e-7"), (0.11, "0.11"), (7.0, "7")]
)
def test_an_error_that_is_not_zero_is_not_said_to_be(shift, found):
    texts = ("failed_where", "doubts")
    numbers = {field.name: 1 for field in fields(SurrogateCertificate)}
    certificate = SurrogateCertificate(
        **{**numbers, **dict.fromkeys(texts, ""), "shift": shift, "shift_tolerance": 0.05}
    )
    assert f"no posterior mean is off by more than {found} posterior" in " ".join(certificate.sentences())

"""Mitsuba's own test of samples against their density."""


def assert_density(sample, density, domain, count, cells):
    """Fail unless samples have a density; `cells` refines its integral over each bin."""
    from mitsuba.chi2 import ChiSquareTest  # it needs a variant

    test = ChiSquareTest(
        domain=domain,
        sample_func=sample,
        pdf_func=density,
        sample_dim=2,
        sample_count=count,
        res=64,
        ires=cells,
    )
    assert test.run(), test.messages

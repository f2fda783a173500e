# Both commands of the README, in one stage.  Not built here: no Docker daemon was at hand; the steps were run
# in a fresh virtual environment instead.  Leave the second RUN out where the tests are not wanted.
FROM python:3.12-slim
WORKDIR /minimax-cal
COPY . .
RUN python3 -m venv .venv && .venv/bin/pip install --quiet ".[all]" && .venv/bin/minimax-cal calibrate irb2600 examples/irb2600.csv --figure errors.svg
RUN python3 -m venv .venv && .venv/bin/pip install --quiet -e ".[test]" && .venv/bin/pytest -n auto
ENV PATH="/minimax-cal/.venv/bin:$PATH"
ENTRYPOINT ["minimax-cal"]
CMD ["--help"]

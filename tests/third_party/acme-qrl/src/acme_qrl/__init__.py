"""What qrlsuite loads at every start: register here, import nothing heavy."""

from pathlib import Path

from qrlsuite import hookimpl, specs


@hookimpl
def register_ansatzes(register):
    register(
        specs.AnsatzSpec(
            name="rzz-ring",
            summary="re-uploaded RY on every qubit, a ring of RZZ, then RX",
            options="acme_qrl.ansatz:Options",
            build="acme_qrl.ansatz:build",
        )
    )


@hookimpl
def register_models(register):
    register(
        specs.ModelSpec(
            name="waves",
            summary="trained Fourier features, the classical relative of re-uploading circuits",
            family="classical",
            options="acme_qrl.model:Options",
            build="acme_qrl.model:build",
        )
    )


@hookimpl
def register_environments(register):
    register(
        specs.EnvironmentSpec(
            name="channel-hop",
            summary="follow a free channel that moves on at every step",
            options="acme_qrl.environment:Options",
            gymnasium_id="acme_qrl/ChannelHop-v1",
            entry_point="acme_qrl.environment:ChannelHop",
        )
    )


@hookimpl
def register_tasks(register):
    path = Path(__file__).parent / "channel-hop.toml"
    register(specs.TaskSpec("channel-hop", "Hop among five channels, 40 steps", str(path)))


@hookimpl
def register_circuit_backends(register):
    register(
        specs.CircuitBackendSpec(
            name="damped",
            summary="native, with every expectation value damped as by noise",
            options="acme_qrl.backend:Options",
            factory="acme_qrl.backend:Damped",
        )
    )


@hookimpl
def register_rules(register):
    register(
        specs.RuleSpec(
            name="half",
            summary="significant where one entry needs less than half the samples",
            factory="acme_qrl.rule:HalfRule",
        )
    )


@hookimpl
def register_trackers(register):
    register(
        specs.TrackerSpec(
            name="acme-log",
            summary="every epoch's median score as a line of a text file",
            factory="acme_qrl.tracker:Log",
        )
    )


@hookimpl
def register_commands(app):
    @app.command("rzz-cost")
    def rzz_cost(qubits: int = 6, layers: int = 4) -> None:
        """Print how many CNOTs a circuit of rzz-ring takes."""
        from qrlsuite.circuit import ansatz

        circuit = ansatz("rzz-ring", qubits, layers)
        print(sum(operation.gate == "CNOT" for operation in circuit))

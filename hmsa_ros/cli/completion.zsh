#compdef hmsa
# Completion of hmsa for zsh: eval "$(hmsa completion zsh)" after compinit
_hmsa_offer() {
  local -a pairs=("$@")
  _describe 'hmsa' pairs
}
_hmsa() {
  local at='' word i
  for ((i = 2; i < CURRENT; i++)); do
    word=${words[i]}
    if [[ $word == --ros-args ]]; then at='--ros-args'; break; fi
    case "${at:+$at }$word" in
      (@paths@) at="${at:+$at }$word" ;;
    esac
  done
  case "$at:${words[CURRENT-1]}" in
@values@
    ('--ros-args:--params-file') _files; return ;;
  esac
  case "$at" in
@words@
    ('--ros-args') _hmsa_offer '-p:set a parameter, NAME:=VALUE' '-r:remap a name, FROM:=TO' \
      '--params-file:file with parameters' '--log-level:lowest severity to log' \
      '--enclave:security enclave' '--disable-rosout-logs:do not publish the log' ;;
  esac
}
if [[ $zsh_eval_context[-1] == loadautofunc ]]; then
  _hmsa "$@"
else
  compdef _hmsa hmsa
fi

{% macro keys(command, option) %}{% for x in option.names %}{{ (command.path ~ ':' ~ x)|quote }}{{ ' | ' if not loop.last }}{% endfor %}{% endmacro %}
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
      ({{ paths|join(' | ') }}) at="${at:+$at }$word" ;;
    esac
  done
  case "$at:${words[CURRENT-1]}" in
{% for command in commands %}
{% for option in command.options if option.value %}
    ({{ keys(command, option) }}) {{ {'one': 'compadd -- ' ~ option.choices|join(' '), 'file': '_files', 'folder': '_files -/', 'any': "_message 'value'"}[option.value] }}; return ;;
{% endfor %}
{% endfor %}
    ('--ros-args:--params-file') _files; return ;;
  esac
  case "$at" in
{% for command in commands %}
    ({{ command.path|quote }}) _hmsa_offer{% for name, text in command.offered.items() %} {{ (name ~ ':' ~ text|replace(':', '\\:') if text else name)|quote }}{% endfor %}{{ '; _files' if command.files }} ;;
{% endfor %}
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

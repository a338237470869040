{% macro keys(command, option) %}{% for x in option.names %}{{ (command.path ~ ':' ~ x)|quote }}{{ ' | ' if not loop.last }}{% endfor %}{% endmacro %}
# Completion of hmsa for bash: eval "$(hmsa completion bash)"
_hmsa_words() {
  local each
  while IFS= read -r each; do COMPREPLY+=("$each"); done \
    < <(compgen -W "$*" -- "$cur")
}
_hmsa_files() {
  local each
  compopt -o filenames 2> /dev/null
  while IFS= read -r each; do COMPREPLY+=("$each"); done < <(compgen "$1" -- "$cur")
}
_hmsa() {
  local cur=${COMP_WORDS[COMP_CWORD]} prev=${COMP_WORDS[COMP_CWORD-1]}
  local at='' word i
  COMPREPLY=()
  for ((i = 1; i < COMP_CWORD; i++)); do
    word=${COMP_WORDS[i]}
    if [[ $word == --ros-args ]]; then at='--ros-args'; break; fi
    case "${at:+$at }$word" in
      {{ paths|join(' | ') }}) at="${at:+$at }$word" ;;
    esac
  done
  case "$at:$prev" in
{% for command in commands %}
{% for option in command.options if option.value %}
    {{ keys(command, option) }}) {{ {'one': '_hmsa_words ' ~ option.choices|join(' '), 'file': '_hmsa_files -f', 'folder': '_hmsa_files -d', 'any': ':'}[option.value] }}; return ;;
{% endfor %}
{% endfor %}
    '--ros-args:--params-file') _hmsa_files -f; return ;;
    --ros-args:-[pr] | '--ros-args:--log-level') return ;;
  esac
  case "$at" in
{% for command in commands %}
    {{ command.path|quote }}) {{ '_hmsa_files -f; ' if command.files }}_hmsa_words {{ command.offered|join(' ') }} ;;
{% endfor %}
    '--ros-args') _hmsa_words -p -r --params-file --log-level --enclave --disable-rosout-logs ;;
  esac
}
complete -F _hmsa hmsa

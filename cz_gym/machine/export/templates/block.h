/*
   $about
*/
#ifndef ${NAME}_H
#define ${NAME}_H

typedef $real ${name}_real;

$bits

typedef struct {
    $inputs
} ${name}_measured;

typedef struct {
    $outputs
} ${name}_setpoints;

/* Settings may be changed after init; the rest is the block's memory. */
typedef struct {
    $settings
    $memory
} $name;

/* Default settings, and reset. */
void ${name}_init($name *block);
/* Forget everything but the settings: the next automatic sample is a takeover. */
void ${name}_reset($name *block);
/* One call; a new sample is taken when the control interval has passed since the last one. */
void ${name}_step($name *block, const ${name}_measured *measured, ${name}_setpoints *setpoints);

#endif /* ${NAME}_H */

/* mps2.h: the few registers of Arm's MPS2 board with image AN386 (a Cortex-M4F) that the example uses; QEMU emulates it. */
#ifndef MPS2_H
#define MPS2_H

#include <stdint.h>

#define CLOCK_HZ 25000000u

struct timer {
    volatile uint32_t control, value, reload, interrupt;
};
struct uart {
    volatile uint32_t data, state, control, interrupt, divider;
};

#define TIMER0 ((struct timer *)0x40000000u)
#define TIMER1 ((struct timer *)0x40001000u)
#define UART0 ((struct uart *)0x40004000u)
#define CPACR (*(volatile uint32_t *)0xE000ED88u)
#define NVIC_ENABLE (*(volatile uint32_t *)0xE000E100u)
#define NVIC_PRIORITY ((volatile uint8_t *)0xE000E400u)
#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014u)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xE000E018u)

enum { TIMER_ON = 1, TIMER_INTERRUPT = 8 };
enum { UART_TX_FULL = 1, UART_RX_FULL = 2 };                /* state */
enum { UART_TX_ON = 1, UART_RX_ON = 2, UART_RX_INTERRUPT = 8 }; /* control */
enum { UART0_RX_NUMBER = 0, TIMER0_NUMBER = 8 };

/* Where the loader puts a random number: QEMU's `-device loader,addr=0x203FFFF0,data=…,data-len=4`. */
#define BOOT_WORD (*(volatile uint32_t *)0x203FFFF0u)

#endif
